"""Walks of someone who stands now and then, from images alone."""

from pathlib import Path

import numpy as np
import pytest
from tiny_run import BARE

from gsba import refine
from gsba.demo import make_walk
from gsba.disk import write_image
from gsba.evaluate.trajectory import evaluate
from gsba.frames.files import decode
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory


@pytest.mark.slow
@pytest.mark.parametrize("stands", [(8, 0, 0), (0, 8, 0), (6, 6, 6)])
def test_a_walk_with_pauses_is_one_map(stands: tuple[int, int, int], tmp_path: Path) -> None:
    """The camera turns by some degrees while it stands at the start, in the middle, at the end."""
    walk, rng = make_walk(tmp_path / "walk", num_frames=24, width=512), np.random.default_rng(0)
    truth, images = read_trajectory(walk.truth_path), sorted(walk.frames_dir.glob("*.jpg"))
    out, poses, copies = tmp_path / "frames", [], np.ones(12, int)
    copies[[0, 6, 11]] += stands
    out.mkdir()
    for f in range(12):
        for k in range(copies[f]):
            image, shift = decode(images[f], (512, 256)), int(rng.integers(-5, 6)) * (k > 0)
            noisy = np.roll(image, shift, axis=1) + 2 * rng.normal(size=image.shape) * (k > 0)
            write_image(out / f"{len(poses):03d}.jpg", np.clip(noisy, 0, 255).astype(np.uint8), 95)
            poses.append(truth.world_T_rigs[f])
    times = np.arange(len(poses), dtype=float)
    rows = [f"{n:03d}.jpg,{time}" for n, time in enumerate(times)]
    (out / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows, ""]))
    result = refine(out, None, tmp_path / "run", BARE)
    found = read_trajectory(tmp_path / "run" / "trajectory.tum")
    assert len(found.timestamps) == len(poses)
    assert evaluate(found, Trajectory(times, np.array(poses))).ate.rmse < 2e-3
    assert result.report["verdict"]["level"] == "good to train"
