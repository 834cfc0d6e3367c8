"""The demo's gallery, built once for all tests, and a walk that is rendered in it."""

from pathlib import Path

import gsba.demo.gallery
from gsba.demo import DemoWalk, make_walk
from gsba.demo.raycast import Scene

OVAL_FRAMES, OVAL_WIDTH = 20, 512


def gallery() -> Scene:
    """The scene that `conftest.py` keeps; tests only read it."""
    return gsba.demo.gallery.build_gallery()


def oval_walk(out: Path) -> DemoWalk:
    """Once around in small frames: the walk that tests of several recordings share."""
    return make_walk(out, "oval", "locked", OVAL_FRAMES, OVAL_WIDTH)
