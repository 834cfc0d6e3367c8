"""Errors that frames have in common, added to those that residuals show."""

import numpy as np
import pytest
from synthetic import loop_walk

from gsba.bundle import common_errors
from gsba.geometry import furthest, step_covariances
from gsba.types import JointErrors

NUM, DRAWS = 40, 4000
POSES = loop_walk(NUM)


def _drawn(seed: int = 0) -> tuple[np.ndarray, JointErrors]:
    """Random walks of errors in the world from the first pose on, each step of one size."""
    rng = np.random.default_rng(seed)
    steps = 1e-3 * rng.normal(size=(DRAWS, NUM, 2, 3))
    steps[:, 0] = 0
    walked = np.cumsum(steps, axis=1)
    draws = np.einsum("fji,dfpj->dfpi", POSES[:, :3, :3], walked).reshape(DRAWS, NUM, 6)
    between = np.einsum("dfi,dfj->fij", draws[:, :-1], draws[:, 1:]) / DRAWS
    return np.einsum("dfi,dfj->fij", draws, draws) / DRAWS, JointErrors(between, draws)


def test_poses_far_along_the_path_are_claimed_less_and_steps_hardly() -> None:
    covariances, joint = _drawn()
    found, further = common_errors.added(covariances, joint, POSES)
    growth = np.trace(found, axis1=1, axis2=2) / np.maximum(
        np.trace(covariances, axis1=1, axis2=2), 1e-12
    )
    assert np.all(growth[10:] > 2)
    before = step_covariances(POSES, covariances, joint.neighbours)
    after = step_covariances(POSES, found, further.neighbours)
    steps = np.trace(after[:, :3, :3], axis1=1, axis2=2)
    steps /= np.trace(before[:, :3, :3], axis1=1, axis2=2)
    assert np.all(steps < 1.6) and np.all(steps > 1)


def test_what_the_gauge_holds_stays_held() -> None:
    found, _ = common_errors.added(*_drawn(), POSES)
    offsets = POSES[:, :3, 3] - POSES[0, :3, 3]
    far, distance = furthest(POSES[:, :3, 3])
    covariances, _ = _drawn()
    along = POSES[far, :3, :3].T @ offsets[far] / distance
    assert np.abs(found[0] - covariances[0]).max() < 1e-15
    extra = (found - covariances)[far, 3:, 3:]
    assert along @ extra @ along < 1e-6 * np.trace(extra)


def test_claims_are_those_of_the_draws() -> None:
    found, further = common_errors.added(*_drawn(), POSES)
    draws = further.draws.astype(float)
    own = np.einsum("dfi,dfj->fij", draws, draws) / DRAWS
    between = np.einsum("dfi,dfj->fij", draws[:, :-1], draws[:, 1:]) / DRAWS
    scale = np.abs(found).max()
    assert np.abs(own - found).max() < 0.1 * scale  # draws of both parts are independent
    assert np.abs(between - further.neighbours).max() < 0.1 * scale


def test_maps_share_nothing_and_unknown_poses_stay_unknown() -> None:
    covariances, joint = _drawn()
    covariances[5], joint.draws[:, 5], joint.neighbours[4:6] = np.nan, np.nan, np.nan
    groups = (np.arange(NUM) >= 20).astype(np.int32)
    found, further = common_errors.added(covariances, joint, POSES, groups)
    assert np.isnan(found[5]).all() and np.isnan(further.draws[:, 5]).all()
    known = np.arange(NUM) != 5
    assert np.isfinite(found[known]).all()
    # the first pose of the second map is held as that of the first is
    assert found[20] == pytest.approx(covariances[20])
