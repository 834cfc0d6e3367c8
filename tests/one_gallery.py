"""The demo's gallery, built once per process for all tests, and walks that are rendered in it."""

from functools import cache
from pathlib import Path

import pytest

from gsba.demo import DemoWalk, make_walk
from gsba.demo.gallery import build_gallery
from gsba.demo.raycast import Scene
from gsba.demo.walk import Heading, WalkPath

OVAL_FRAMES, OVAL_WIDTH = 20, 512


@cache
def gallery() -> Scene:
    return build_gallery()


def walk_in_gallery(
    out: Path, path: WalkPath, heading: Heading, num_frames: int, width: int
) -> DemoWalk:
    """A rendered walk, as `make_walk` writes it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsba.demo.gallery.build_gallery", gallery)
        return make_walk(out, path, heading, num_frames, width)


def oval_walk(out: Path) -> DemoWalk:
    """Once around in small frames: the walk that tests of several recordings share."""
    return walk_in_gallery(out, "oval", "locked", OVAL_FRAMES, OVAL_WIDTH)
