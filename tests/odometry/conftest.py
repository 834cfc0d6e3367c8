"""What tests of odometry share."""

import pytest
from dense_walk import RenderedWalk, render_walk


@pytest.fixture(scope="session")
def walk() -> RenderedWalk:
    """Rendered once for all tests."""
    return render_walk()
