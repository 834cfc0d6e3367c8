"""Calls that the library refuses in one line."""

from collections.abc import Callable

import pytest

from gsba.log import GsbaError


def refused(message: str, call: Callable[..., object], *given: object, **options: object) -> str:
    """The call raises a GsbaError of one line that matches the regular expression `message`.

    Returns the line.
    """
    with pytest.raises(GsbaError, match=message) as caught:
        call(*given, **options)
    line = str(caught.value)
    assert "\n" not in line
    return line
