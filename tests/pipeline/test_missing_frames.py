"""Walks through halls of bays, frames missing or far apart, without a trajectory."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from gsba import load_run, refine
from gsba.evaluate.trajectory import evaluate
from gsba.trajectory.files import read_trajectory
from gsba.types import FrameSet, Reconstruction, Trajectory

GALLERY = Path(__file__).parents[3] / "shared/data/gallery_forward"
NUM = 16


@pytest.mark.slow
@pytest.mark.skipif(not GALLERY.is_dir(), reason="../shared/data/gallery_forward is not here")
@pytest.mark.parametrize("timed", [True, False])
def test_no_step_over_a_missing_frame_is_a_bay_too_short(timed: bool, tmp_path: Path) -> None:
    """Hundreds of matches say so; times, or the numbers of the frames, tell otherwise."""
    kept = [n for n in range(NUM) if n % 4 != 3]
    _take(kept, tmp_path / "frames", timed)
    refine(tmp_path / "frames", None, tmp_path / "run")
    reconstruction, frames = load_run(tmp_path / "run")
    assert len(frames.names) >= len(kept) // 2  # the report lists the others as left out
    assert _ate(reconstruction, frames) < 0.02  # steps are 0.8 to 1.6 units, bays 2.6


@pytest.mark.slow
@pytest.mark.skipif(not GALLERY.is_dir(), reason="../shared/data/gallery_forward is not here")
def test_no_step_of_frames_far_apart_leads_back_by_a_bay(tmp_path: Path) -> None:
    """Many do, of 1.6 units; what is kept must be right."""
    _take(list(range(0, 48, 2)), tmp_path / "frames", timed=True)
    assert refine(tmp_path / "frames", None, tmp_path / "run").partial
    maps = json.loads((tmp_path / "run/report.json").read_text())["maps"]
    for each in maps:
        assert _ate(*load_run(tmp_path / "run", each["map"])) < 0.02


def _take(kept: list[int], to: Path, timed: bool) -> None:
    """Copy some frames of the gallery."""
    to.mkdir()
    truth = read_trajectory(GALLERY / "groundtruth.tum")
    images = sorted((GALLERY / "images").glob("*.jpg")) or sorted(
        (GALLERY / "images").glob("*.png")
    )
    for n in kept:
        shutil.copy(images[n], to / f"{n:04d}{images[n].suffix}")
    if timed:
        rows = [f"{n:04d},{truth.timestamps[n]}" for n in kept]
        (to / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))


def _ate(reconstruction: Reconstruction, frames: FrameSet) -> float:
    """ATE of a map, in units of the gallery."""
    truth = read_trajectory(GALLERY / "groundtruth.tum")
    times = np.arange(float(len(frames.names)))
    found = Trajectory(times, reconstruction.world_T_rigs)
    true = Trajectory(times, truth.world_T_rigs[[int(name) for name in frames.names]])
    return evaluate(found, true).ate.rmse
