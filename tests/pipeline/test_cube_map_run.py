"""Runs on both tracks of an equi-angular cube map, of a rendered walk and of a real camera."""

from pathlib import Path

import numpy as np
import pytest
from cube_map_tracks import looking_up, picture_tracks
from tiny_run import NUM_FRAMES, ONE_ROUND, WIDTH, Case
from two_fisheyes import write

from gsba import refine
from gsba.frames import load_erp, scan
from gsba.pipeline.outputs import RunResult
from gsba.types import PoseStatus

REAL = Path(__file__).parents[3] / "shared" / "data" / "real" / "max_eac"
needs_real = pytest.mark.skipif(not REAL.is_dir(), reason="no ../shared/data/real/max_eac")


def _num_refined(result: RunResult) -> int:
    return int(np.sum(result.reconstruction.pose_statuses == PoseStatus.REFINED))


def test_tracks_of_a_walk_give_its_poses(tmp_path: Path, case: Case) -> None:
    """About as good as the panoramas they are made of, though these were resampled once more."""
    frames, tracks = scan(case.frames), tmp_path / "tracks"
    for f, name in enumerate(frames.names):
        shown = picture_tracks(WIDTH // 4, 8, looking_up(load_erp(frames, f)))
        for track, picture in zip(("track0", "track5"), shown, strict=True):
            write(tracks / track / f"{name}.png", picture)
    times = (case.frames / "timestamps.csv").read_text()
    (tracks / "timestamps.csv").write_text(times)
    result = refine(tracks, case.slam, tmp_path / "run", ONE_ROUND)
    assert _num_refined(result) == NUM_FRAMES
    own, other = case.errors(), case.errors(tmp_path / "run")
    assert other.ate.rmse < 2 * own.ate.rmse
    assert other.rpe_rotation_deg.rmse < 2 * own.rpe_rotation_deg.rmse


@needs_real
@pytest.mark.slow
def test_a_real_camera(tmp_path: Path) -> None:
    """A garden, hand-held, at 3K: all frames, though but four, and as exact as panoramas are."""
    result = refine(REAL, None, tmp_path / "run")
    assert _num_refined(result) == 4
    assert np.rad2deg(np.median(result.reconstruction.point_errors)) < 0.02  # 0.014
    faces = sorted(path.name for path in (tmp_path / "run").glob("colmap/images/**/*.jpg"))
    assert len(faces) == 24
