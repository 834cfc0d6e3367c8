"""The demo's gallery, built once for all tests, and a walk that is rendered in it."""

from pathlib import Path

from tiny_run import settings_with

import gsba.demo.gallery
from gsba.config import RefineSettings
from gsba.demo import DemoWalk, make_walk
from gsba.demo.raycast import Scene

OVAL_FRAMES, OVAL_WIDTH = 20, 512
OVAL_KEYPOINTS = 250  # per face: its frames see much of each other


def gallery() -> Scene:
    """The scene that `conftest.py` keeps; tests only read it."""
    return gsba.demo.gallery.build_gallery()


def oval_walk(out: Path) -> DemoWalk:
    """Once around in small frames: the walk that tests of several recordings share."""
    return make_walk(out, "oval", "locked", OVAL_FRAMES, OVAL_WIDTH)


def oval_settings(*formats: str, rounds: int = 2, **options: object) -> RefineSettings:
    """Light settings of runs of that walk, with rounds of patches and exports."""
    return settings_with(
        features={"max_per_face": OVAL_KEYPOINTS},
        patches={"rounds": rounds},
        export={"formats": formats, **options},
    )
