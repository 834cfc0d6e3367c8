"""The odometry of a video on a run's page: maps from above, loops and losses."""

import numpy as np

from gsba.odometry import Odometry
from gsba.odometry.tracker_state import FrameStatus
from gsba.report.html.figures import odometry_plan


def test_maps_lie_side_by_side_with_their_loops_and_losses() -> None:
    num = 24
    poses = np.tile(np.eye(4), (num, 1, 1))
    poses[:12, 0, 3] = np.arange(12)
    poses[14:, 2, 3] = np.arange(10)
    statuses = np.full(num, FrameStatus.TRACKED, np.uint8)
    statuses[[5, 12, 13]] = FrameStatus.LOST
    maps = np.repeat([0, 2], [14, 10]).astype(np.int32)
    keyframes = np.arange(num) % 3 == 0
    distances, inliers, times = np.ones(num), np.full(num, 80), np.arange(num) / 10.0
    known = statuses, maps, keyframes, distances, inliers, np.ones(num)
    loops = np.array([[0, 10]])
    found = odometry_plan(Odometry(times, poses, *known, 1.0, None, loops))
    first, second = found["maps"]
    assert len(first["positions"]) == 11 and len(second["positions"]) == 10
    np.testing.assert_array_equal(np.flatnonzero(first["lost"]), [5])  # the frame after the loss
    assert first["positions"][:, 0].max() < second["positions"][:, 0].min()
    assert np.isclose(np.ptp(first["positions"], axis=0).max(), 11)
    assert np.isclose(np.linalg.norm(np.subtract(*found["loops"][0])), 10)
    assert "1 loop closed" in found["summary"] and found["joins"].shape == (0, 2, 2)
