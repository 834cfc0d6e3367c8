"""Walks through halls of bays of which frames are missing one by one, without a trajectory."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from gsba import load_run, refine
from gsba.evaluate.trajectory import evaluate
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

GALLERY = Path(__file__).parents[3] / "shared/data/gallery_forward"
NUM = 16


@pytest.mark.slow
@pytest.mark.skipif(not GALLERY.is_dir(), reason="../shared/data/gallery_forward is not here")
@pytest.mark.parametrize("timed", [True, False])
def test_no_step_over_a_missing_frame_is_a_bay_too_short(timed: bool, tmp_path: Path) -> None:
    """Hundreds of matches say so; times, or the numbers of the frames, tell otherwise."""
    (tmp_path / "frames").mkdir()
    kept = [n for n in range(NUM) if n % 4 != 3]
    truth = read_trajectory(GALLERY / "groundtruth.tum")
    images = sorted((GALLERY / "images").glob("*.jpg")) or sorted(
        (GALLERY / "images").glob("*.png")
    )
    for n in kept:
        shutil.copy(images[n], tmp_path / "frames" / f"{n:04d}{images[n].suffix}")
    if timed:
        rows = [f"{n:04d},{truth.timestamps[n]}" for n in kept]
        (tmp_path / "frames/timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))
    refine(tmp_path / "frames", None, tmp_path / "run")
    reconstruction, frames = load_run(tmp_path / "run")
    rows = [int(name) for name in frames.names]
    assert len(rows) >= len(kept) // 2  # the report lists the others as left out
    times = np.arange(float(len(rows)))
    found = Trajectory(times, reconstruction.world_T_rigs)
    true = Trajectory(times, truth.world_T_rigs[rows])
    assert evaluate(found, true).ate.rmse < 0.02  # steps are 0.8 to 1.6 units, bays 2.6
