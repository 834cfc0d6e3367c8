"""Truths that do not fit a right estimate: mirrored, on another clock, of other axes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.evaluate.truth_check import fault_of_truth
from gsba.geometry import pose
from gsba.types import Trajectory

T = np.arange(40) * 0.5
TURNS = Rotation.from_euler("yxz", np.column_stack([4 * T, 9 * np.sin(T), 5 * np.cos(T)]), True)
WALK = np.column_stack([9 * np.sin(T / 3), 0.3 * np.sin(2 * T), 5 * np.cos(T / 3)])
TRUTH = Trajectory(T, pose(TURNS.as_matrix(), WALK))


def _estimate(noise: float = 0.001) -> Trajectory:
    poses = TRUTH.world_T_rigs.copy()
    poses[:, :3, 3] = 0.4 * (WALK + np.random.default_rng(0).normal(0, noise, WALK.shape))
    return Trajectory(T, poses)


def _turned(right: Rotation) -> np.ndarray:
    return pose((TURNS * right).as_matrix(), WALK)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.3])
def test_a_right_truth_has_no_fault(noise: float) -> None:
    assert fault_of_truth(_estimate(noise), TRUTH) == ""


def test_a_walk_in_the_middle_of_the_truth_is_found() -> None:
    walk = Trajectory(T[:20], _estimate().world_T_rigs[15:35])
    assert "clock is 7.5 s ahead: with -7.5 s added" in fault_of_truth(walk, TRUTH)


def test_one_false_pose_is_no_other_clock() -> None:
    poses = TRUTH.world_T_rigs.copy()
    poses[9, :3, 3] += 5.0
    assert fault_of_truth(_estimate(), Trajectory(T, poses)) == ""


@pytest.mark.parametrize(
    ("truth", "fault"),
    [
        (Trajectory(T, pose(TURNS.as_matrix(), WALK * [-1, 1, 1])), "the truth is mirrored"),
        (Trajectory(T, pose(TURNS.as_matrix(), WALK[:, [0, 2, 1]])), "the truth is mirrored"),
        (Trajectory(T + 1.0, TRUTH.world_T_rigs), "clock is 1 s ahead: with -1 s added"),
        (Trajectory(T - 0.5, TRUTH.world_T_rigs), "clock is 0.5 s behind: with +0.5 s added"),
        (
            Trajectory(T, _turned(Rotation.from_euler("x", 180, True))),
            "orientations contradict its positions by 180 degrees",
        ),
    ],
)
def test_faults_are_told(truth: Trajectory, fault: str) -> None:
    assert fault in fault_of_truth(_estimate(), truth)
