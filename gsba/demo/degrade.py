"""SLAM-like errors added to an exact trajectory."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse, pose
from gsba.types import Trajectory


@dataclass(frozen=True, slots=True)
class Drift:
    """Largest values of the random walks that a trajectory's errors are."""

    rotation_deg: float = 2.0  # angle
    translation: float = 0.015  # offset, part of the path length; the others bend the path further
    scale: float = 0.02  # relative change


def degrade(
    truth: Trajectory,
    seed: int = 0,
    *,
    scale: float = 0.4,
    drift: Drift | None = None,
    jitter: float = 1e-3,
    num_jumps: int = 0,
    num_lost: int = 0,
) -> Trajectory:
    """Trajectory like that of monocular SLAM on the same motion: with drift, no loop closure.

    Errors of rotation, position and scale are smooth random walks along the path. The first pose
    is the identity.

    Args:
        truth: N exact poses.
        scale: SLAM units per unit of `truth`.
        drift: errors that grow along the path; None = those of a good SLAM system.
        jitter: standard deviation of each pose's independent error, per axis: part of the mean step
            length in position, radians in rotation.
        num_jumps: number of sudden displacements of all later poses, like wrong relocalisations,
            of half a step and half a degree each.
        num_lost: number of missing poses, in gaps of up to three, never the first or last.

    Returns:
        Trajectory of N - num_lost poses.
    """
    drift = drift or Drift()
    rng = np.random.default_rng(seed)
    count = len(truth.timestamps)
    rotations, positions = truth.world_T_rigs[:, :3, :3], truth.world_T_rigs[:, :3, 3]
    steps = np.diff(positions, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    angles = _random_walk(rng, lengths, 3, np.radians(drift.rotation_deg))
    offsets = _random_walk(rng, lengths, 3, drift.translation * lengths.sum())
    log_scales = _random_walk(rng, lengths, 1, np.log1p(drift.scale))
    for frame in rng.choice(np.arange(1, count), num_jumps, replace=False):
        angles[frame:] += np.radians(0.5) * _unit(rng)
        offsets[frame:] += 0.5 * lengths.mean() * _unit(rng)
    turns = Rotation.from_rotvec(angles)
    bent = np.exp(log_scales[:-1]) * turns[:-1].apply(steps)
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(bent, axis=0)]) + offsets
    positions += jitter * lengths.mean() * rng.standard_normal((count, 3))
    shake = Rotation.from_rotvec(jitter * rng.standard_normal((count, 3)))
    rotations = (turns * Rotation.from_matrix(rotations) * shake).as_matrix()
    kept = _kept(rng, count, num_lost)
    world_T_rigs = pose(rotations, positions)[kept]
    first_T_rigs = inverse(world_T_rigs[0]) @ world_T_rigs
    first_T_rigs[:, :3, 3] *= scale
    return Trajectory(truth.timestamps[kept], first_T_rigs)


def _random_walk(
    rng: np.random.Generator, lengths: np.ndarray, dimensions: int, largest: float
) -> np.ndarray:
    """Smooth random walk (N, dimensions) over N - 1 path steps, from 0, up to norm `largest`."""
    increments = np.sqrt(lengths)[:, None] * rng.standard_normal((len(lengths), dimensions))
    walk = np.concatenate([np.zeros((1, dimensions)), np.cumsum(increments, axis=0)])
    walk = gaussian_filter1d(walk, 1.5, axis=0, mode="nearest")  # drift is smooth over 1.5 frames
    walk -= walk[0]
    return walk * largest / max(np.linalg.norm(walk, axis=1).max(), 1e-12)


def _unit(rng: np.random.Generator) -> np.ndarray:
    direction = rng.standard_normal(3)
    return direction / np.linalg.norm(direction)


def _kept(rng: np.random.Generator, count: int, num_lost: int) -> np.ndarray:
    """Mask (count,) bool of the kept poses, the first and last one among them."""
    kept = np.ones(count, dtype=bool)
    num_lost = min(num_lost, count - 3)
    while (left := num_lost - np.count_nonzero(~kept)) > 0:
        start = int(rng.integers(1, count - 1))
        gap = min(int(rng.integers(1, 4)), left)
        kept[start : min(start + gap, count - 1)] = False
    return kept
