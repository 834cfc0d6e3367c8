"""Calls that the library refuses in one line."""

from collections.abc import Callable

import pytest

from gsba.log import GsbaError


def refused(message: str, call: Callable[..., object], *given: object, **options: object) -> None:
    """The call raises a GsbaError whose text matches the regular expression `message`."""
    with pytest.raises(GsbaError, match=message):
        call(*given, **options)
