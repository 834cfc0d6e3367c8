"""A camera that only turns: rotations and their covariances, without any point."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import keypoints_of, unit, with_noise

from gsba.bundle import rotation_only
from gsba.geometry import rotation_angle
from gsba.types import Keypoints, Tracks

NUM, DIRECTIONS, SIGMA = 40, 800, 1e-3


def _scene(false_share: float) -> tuple[np.ndarray, Tracks, Keypoints]:
    rng = np.random.default_rng(0)
    around = 2 * np.pi * np.arange(NUM) / NUM
    sway = np.column_stack([0.1 * np.sin(around), around, 0.05 * np.cos(around)])
    rotations = Rotation.from_rotvec(sway).as_matrix()
    directions = unit(rng.normal(size=(DIRECTIONS, 3)))
    bearings = [with_noise(directions @ rotation, SIGMA, rng) for rotation in rotations]
    bearings = np.concatenate(bearings)
    false = rng.random(len(bearings)) < false_share
    bearings[false] = unit(rng.normal(size=(false.sum(), 3)))
    keypoints = keypoints_of(np.arange(NUM + 1) * DIRECTIONS, bearings, SIGMA)
    which, frames = np.nonzero((rng.random((NUM, DIRECTIONS)) < 0.3).T)
    which, frames = which.astype(np.int32), frames.astype(np.int32)
    return rotations, Tracks(which, frames, which, DIRECTIONS), keypoints


def _drifting(rotations: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(1)
    drift = np.cumsum(rng.normal(0, 0.003, (NUM, 3)), axis=0)
    drift -= drift[0]
    drift *= 0.03 / np.linalg.norm(drift, axis=1).max()
    return rotations @ Rotation.from_rotvec(drift).as_matrix()


def test_rotations_are_found_to_their_covariances() -> None:
    rotations, tracks, keypoints = _scene(false_share=0.05)
    start = _drifting(rotations)
    found, covariances, used = rotation_only.solve(start, tracks, keypoints)
    errors = Rotation.from_matrix(np.swapaxes(rotations, 1, 2) @ found).as_rotvec()
    before = rotation_angle(np.swapaxes(rotations, 1, 2) @ start)
    assert np.linalg.norm(errors, axis=1).max() < 5e-4 < 0.02 < before.max()
    np.testing.assert_allclose(found[0], rotations[0], atol=1e-12)
    # Squared errors in units of the covariances: three for each of 39 frames.
    squares = [e @ np.linalg.solve(c, e) for e, c in zip(errors[1:], covariances[1:], strict=True)]
    assert 0.5 < np.mean(squares) / 3 < 2
    assert used.min() > 0.2 * DIRECTIONS


def test_exact_rays_give_exact_rotations() -> None:
    rotations, tracks, keypoints = _scene(false_share=0.0)
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    exact = np.concatenate([unit(directions) @ rotation for rotation in rotations])
    keypoints = replace(keypoints, bearings_rig=exact)
    found, _, _ = rotation_only.solve(_drifting(rotations), tracks, keypoints)
    assert rotation_angle(np.swapaxes(rotations, 1, 2) @ found).max() < 1e-8


def test_covariances_cover_the_parallax_of_a_hand() -> None:
    """In a room, what a hand of 3 cm moves looks alike all over a wall: no noise of a point."""
    rotations, tracks, keypoints = _scene(false_share=0.0)
    rng = np.random.default_rng(3)
    rays, corner = unit(rng.normal(size=(DIRECTIONS, 3))), np.array([1.2, 1.0, 3.0])
    walls = np.where(rays > 0, corner, 4.5 - corner)
    points = rays * np.min(walls / np.abs(rays), axis=1)[:, None]
    hand = rng.normal(0, 0.03, (NUM, 3))
    seen = [
        with_noise(unit(points - at) @ turn, SIGMA, rng)
        for at, turn in zip(hand, rotations, strict=True)
    ]
    moved = replace(keypoints, bearings_rig=np.concatenate(seen))
    found, covariances, _ = rotation_only.solve(_drifting(rotations), tracks, moved)
    errors = Rotation.from_matrix(np.swapaxes(rotations, 1, 2) @ found).as_rotvec()
    squares = [e @ np.linalg.solve(c, e) for e, c in zip(errors[1:], covariances[1:], strict=True)]
    assert 0.1 < np.mean(squares) / 3 < 3
