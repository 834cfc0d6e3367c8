"""Pose of one frame from points of a map, and when not to believe it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, unit, with_noise

from gsba.geometry import inverse, pose, rotation_angle
from gsba.loop_closure.registration import resect
from gsba.trajectory.limits import TwoViewLimits

SETTINGS = TwoViewLimits()
POSE = pose(Rotation.from_rotvec([0.3, 2.5, -0.4]).as_matrix(), np.array([0.5, -0.2, 0.3]))
OTHER = pose(Rotation.from_rotvec([0.0, 0.4, 0.0]).as_matrix(), np.array([-1.5, 0.1, 1.3]))


def _points(rng: np.random.Generator, num: int, cone_deg: float = 180.0) -> np.ndarray:
    """Points (num, 3) between 2 and 5 away from the frame, around its z axis."""
    share = 0.5 - 0.5 * np.cos(np.deg2rad(cone_deg))  # of the sphere
    rays = unit(rng.normal(size=(max(100 * num, int(2 * num / share)), 3)))
    rays = rays[rays[:, 2] > np.cos(np.deg2rad(cone_deg))][:num]
    assert len(rays) == num
    return (rng.uniform(2, 5, (len(rays), 1)) * rays) @ POSE[:3, :3].T + POSE[:3, 3]


def _seen(points: np.ndarray, world_T_rig: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return with_noise(bearings_of(points, world_T_rig), 3e-4, rng)


@pytest.mark.parametrize("false_share", [0.0, 0.5, 0.7])
def test_most_bearings_may_be_false(false_share: float) -> None:
    rng = np.random.default_rng(0)
    points = _points(rng, 200)
    bearings = _seen(points, POSE, rng)
    false = rng.random(len(points)) < false_share
    bearings[false] = unit(rng.normal(size=(false.sum(), 3)))
    found = resect(bearings, points, SETTINGS, 0)
    assert found is not None
    off = inverse(POSE) @ found.world_T_rig
    assert np.linalg.norm(off[:3, 3]) < 0.01 and np.degrees(rotation_angle(off[:3, :3])) < 0.1
    assert found.inliers[~false].mean() > 0.98 and found.inliers[false].sum() < 0.05 * 200


def test_points_in_one_narrow_cone_are_not_believed() -> None:
    rng = np.random.default_rng(1)
    points = _points(rng, 100, cone_deg=6.0)
    assert resect(_seen(points, POSE, rng), points, SETTINGS, 0) is None
    wider = _points(rng, 100, cone_deg=30.0)
    assert resect(_seen(wider, POSE, rng), wider, SETTINGS, 0) is not None


def test_two_places_that_explain_it_alike_are_not_believed() -> None:
    rng = np.random.default_rng(3)
    points = _points(rng, 160)
    bearings = np.concatenate([_seen(points[:80], POSE, rng), _seen(points[80:], OTHER, rng)])
    assert resect(bearings, points, SETTINGS, 0) is None
    clear = np.concatenate([bearings[:80], bearings[80:110]])
    assert resect(clear, points[:110], SETTINGS, 0) is not None


def test_too_few_are_nothing() -> None:
    rng = np.random.default_rng(4)
    points = _points(rng, 24)
    assert resect(_seen(points, POSE, rng), points, SETTINGS, 0) is None
    assert resect(unit(rng.normal(size=(60, 3))), _points(rng, 60), SETTINGS, 0) is None
