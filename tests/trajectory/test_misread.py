"""Trajectories that are not of these images are refused, with the reason where there is one."""

from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import ROS, drifted, loop_walk, unit, w_first

from gsba.config import RefineSettings
from gsba.geometry import inverse, pose
from gsba.log import GsbaError
from gsba.matching import recovery
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.misread import (
    TurnedAboutForwardError,
    refuse_misfit,
    refuse_misread,
    refuse_useless,
)
from gsba.trajectory.steps import Steps
from gsba.types import CoarsePoses, PoseSource, Trajectory, VerifiedPairs

NUM = 30
SLAM = drifted(loop_walk(NUM), np.random.default_rng(0))
MIRROR, OPENGL = np.diag([-1.0, 1, 1, 1]), np.diag([1.0, -1, -1, 1])
TURNED, ROLLED = np.diag([-1.0, 1, -1, 1]), np.diag([-1.0, -1, 1, 1])


def _coarse(world_T_rigs: np.ndarray) -> CoarsePoses:
    return CoarsePoses(world_T_rigs, np.full(len(world_T_rigs), PoseSource.SLAM, np.uint8), 0.0)


def _found() -> Steps:
    truth = loop_walk(NUM)
    steps = inverse(truth[:-1]) @ truth[1:]
    steps[:, :3, 3] = unit(steps[:, :3, 3])
    every = np.ones(NUM - 1, bool)
    return Steps(steps, every, every)


def _another() -> np.ndarray:
    rng = np.random.default_rng(5)
    poses = pose(np.tile(np.eye(3), (NUM, 1, 1)), np.cumsum(rng.normal(size=(NUM, 3)), axis=0))
    return poses


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (SLAM[::-1], "reversed in time"),
        (inverse(SLAM), "is camera-from-world: pass --trajectory-format camera-from-world, or"),
        (MIRROR @ SLAM @ MIRROR, "mirrored along x"),
        (OPENGL @ SLAM @ OPENGL, "y up, z back: pass --trajectory-format right-up-back, or"),
        (
            TURNED @ SLAM @ TURNED,
            "pass --trajectory-format left-down-back; or it is on another clock",
        ),
        (ROLLED @ SLAM @ ROLLED, "pass --trajectory-format left-up-forward, or"),
        (SLAM @ ROS, "x forward, y left, z up: pass --trajectory-format forward-left-up, or"),
        (w_first(SLAM), "order w, x, y, z: pass --trajectory-format wxyz, or"),
        (w_first(SLAM @ ROS), "z up: pass --trajectory-format wxyz,forward-left-up, or"),
        (_another(), "another recording"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(poses: np.ndarray, said: str) -> None:
    assert "--no-trajectory" in refused(
        said, refuse_misfit, _coarse(poses), _found(), TwoViewLimits()
    )


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turns_about_the_forward_axis_are_told_with_their_rotation(quarters: int) -> None:
    """By which raw pictures of a sensor on its side are cut upright."""
    ours_R_theirs = Rotation.from_euler("z", 90 * quarters, degrees=True).as_matrix()
    turned = SLAM @ pose(ours_R_theirs, np.zeros(3))
    with pytest.raises(TurnedAboutForwardError, match="z forward") as refused:
        refuse_misread(_coarse(turned), _found(), TwoViewLimits())
    np.testing.assert_allclose(refused.value.ours_R_theirs, ours_R_theirs, atol=1e-12)


def test_a_late_clock_or_another_recording_are_not_misread() -> None:
    refuse_misread(_coarse(np.roll(SLAM, 9, axis=0)), _found(), TwoViewLimits())
    refuse_misread(_coarse(_another()), _found(), TwoViewLimits())
    refused("reversed in time", refuse_misread, _coarse(SLAM[::-1]), _found(), TwoViewLimits())


@pytest.mark.parametrize(("late", "standing"), [(12, 0.0), (-13, 0.0), (12, 0.4)])
def test_the_other_side_of_a_loop_is_another_clock(late: int, standing: float) -> None:
    """Without turning, half a loop away every step goes the other way, as in inverted poses;
    `standing`: share of steps whose direction images leave open."""
    truth = loop_walk(NUM)
    truth[:, :3, :3] = np.eye(3)
    steps = inverse(truth[:-1]) @ truth[1:]
    steps[:, :3, 3] = unit(steps[:, :3, 3])
    stands = np.arange(NUM - 1) % 10 < 10 * standing
    steps[stands, :3, 3] = [0.0, 1.0, 0.0]
    found = Steps(steps, np.ones(NUM - 1, bool), np.where(stands, np.inf, 0.01))
    ahead = np.arange(NUM) + late
    sources = np.where((ahead >= 0) & (ahead < NUM), PoseSource.SLAM, PoseSource.EXTRAPOLATED)
    poses = CoarsePoses(truth[ahead.clip(0, NUM - 1)], sources.astype(np.uint8), 0.0)
    refuse_misread(poses, found, TwoViewLimits())
    line = refused(
        r"on another clock, by about [0-9]+ frames", refuse_misfit, poses, found, TwoViewLimits()
    )
    said = int(line.split("about ")[1].split()[0])
    assert abs(said - abs(late)) <= 1  # a step turns by 12 degrees, and 20 are no contradiction


def test_a_reversed_trajectory_is_refused_before_another_clock_is_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recovery, "match_anywhere", lambda *_: VerifiedPairs.none())
    monkeypatch.setattr(recovery, "image_steps", lambda *_: _found())
    context = SimpleNamespace(settings=RefineSettings(), keypoints=None)
    times = np.arange(float(NUM))
    trajectory = Trajectory(times, SLAM[::-1])
    given = context, VerifiedPairs.none(), _coarse(SLAM[::-1]), times, trajectory
    with pytest.raises(GsbaError, match="reversed in time"):
        recovery.check_clock(*given)  # type: ignore[arg-type]


def test_many_outliers_are_no_reason_to_refuse() -> None:
    refuse_misfit(_coarse(SLAM), _found(), TwoViewLimits())
    bad = SLAM.copy()
    rng = np.random.default_rng(0)
    which = rng.choice(NUM, NUM // 3, replace=False)
    bad[which, :3, 3] += 3 * unit(rng.normal(size=(len(which), 3)))
    refuse_misfit(_coarse(bad), _found(), TwoViewLimits())


def test_identical_poses_are_refused() -> None:
    with pytest.raises(GsbaError, match="all 5 poses of the trajectory are identical"):
        refuse_useless(_coarse(np.tile(SLAM[3], (5, 1, 1))))
    refuse_useless(_coarse(SLAM))
