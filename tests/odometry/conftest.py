"""What tests of odometry share."""

import pytest
from dense_walk import RenderedWalk, render_walk
from made_once import MadeOnce


@pytest.fixture(scope="session")
def walk(made_once: MadeOnce) -> RenderedWalk:
    """Rendered once for all tests."""
    return made_once("dense-walk", lambda _: render_walk())
