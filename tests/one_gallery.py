"""The demo's gallery, built once per process for all tests, and a walk that is rendered in it."""

from functools import cache
from pathlib import Path

from gsba.demo import DemoWalk, make_walk
from gsba.demo.gallery import build_gallery
from gsba.demo.raycast import Scene

OVAL_FRAMES, OVAL_WIDTH = 20, 512


@cache
def gallery() -> Scene:
    return build_gallery()


def oval_walk(out: Path) -> DemoWalk:
    """Once around in small frames: the walk that tests of several recordings share."""
    return make_walk(out, "oval", "locked", OVAL_FRAMES, OVAL_WIDTH)
