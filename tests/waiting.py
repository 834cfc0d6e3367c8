"""Waiting for what another thread or process does."""

import time
from collections.abc import Callable

import pytest


def until(condition: Callable[[], bool], seconds: float) -> None:
    """Return once the condition holds; the test fails if it does not within so many seconds."""
    for _ in range(round(20 * seconds)):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail(f"it did not happen within {seconds:g} s")
