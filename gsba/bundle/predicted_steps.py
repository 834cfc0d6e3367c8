"""Steps predicted by far frames, and their motion by a round: frames that stand close together may
hold a tiny map of their own, whose covariances do not tell; far frames' points do."""

import numpy as np
from scipy.spatial.transform import Rotation

from factors import tangent_basis
from gsba.geometry import inverse, pose, step_covariances
from gsba.types import JointErrors, Reconstruction

_REACH = 3  # frames to either side that do not count as far
_STANDING_RATIO = 0.1  # of the rms step: shorter ones are of a camera that stands, and mere noise
_ITERATIONS = 10


def step_deviations(result: Reconstruction) -> np.ndarray:
    """Deviation (F - 1,) of each step from the one that far frames predict, part of the longer of
    both, and at least a tenth of the rms step; NaN = they predict none.
    """
    poses = result.world_T_rigs
    predicted, known = poses.copy(), np.zeros(len(poses), bool)
    # observations of each observation's point in frames out of reach
    frames, num = result.observation_frames.astype(np.int64), len(poses)
    first = result.observation_points.astype(np.int64) * num
    keys = np.sort(first + frames)  # by point, then frame
    last = np.searchsorted(keys, first + np.minimum(frames + _REACH, num - 1), side="right")
    near = last - np.searchsorted(keys, first + np.maximum(frames - _REACH, 0))
    every = np.bincount(result.observation_points)[result.observation_points]
    usable = np.flatnonzero(every - near >= 2)  # that see a point
    usable = usable[np.argsort(result.observation_frames[usable], kind="stable")]
    bounds = np.searchsorted(result.observation_frames[usable], np.arange(len(poses) + 1))
    for f in range(len(poses)):
        rows = usable[bounds[f] : bounds[f + 1]]
        known[f] = len(rows) >= 12  # of such points, in a frame
        if known[f]:
            predicted[f] = _resected(result, f, rows)
    steps = [(inverse(some[:-1]) @ some[1:])[:, :3, 3] for some in (poses, predicted)]
    lengths = np.linalg.norm(steps, axis=2)
    least = _STANDING_RATIO * np.sqrt(np.mean(lengths[0] ** 2))
    off = np.linalg.norm(steps[0] - steps[1], axis=1) / np.maximum(lengths.max(axis=0), least)
    return np.where(known[1:] & known[:-1], off, np.nan)


def _resected(result: Reconstruction, frame: int, rows: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a frame by its observations `rows` (O,) of points, from that in the map."""
    from scipy.spatial.transform import Rotation

    points = result.points_world[result.observation_points[rows]]
    bearings, sigmas = result.observation_bearings[rows], result.observation_sigmas[rows]
    origins = 0.0 if result.observation_origins is None else result.observation_origins[rows]
    bases, world_T_rig = tangent_basis(bearings), result.world_T_rigs[frame]
    for _ in range(_ITERATIONS):
        at_rig = (points - world_T_rig[:3, 3]) @ world_T_rig[:3, :3]
        depths = np.linalg.norm(at_rig - origins, axis=1)
        rays = (at_rig - origins) / depths[:, None]
        residuals = np.einsum("mij,mj->mi", bases, rays) / sigmas[:, None]
        weights = 1 / (1 + np.sum(residuals**2, axis=1))
        across = (np.eye(3) - rays[:, :, None] * rays[:, None, :]) / depths[:, None, None]
        by_ray = bases @ across / sigmas[:, None, None]
        jacobian = np.concatenate([np.cross(by_ray, at_rig[:, None, :]), -by_ray], axis=2)
        weighted = weights[:, None, None] * jacobian
        system = np.einsum("mij,mik->jk", weighted, jacobian)
        step = np.linalg.lstsq(system, -np.einsum("mij,mi->j", weighted, residuals), rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        world_T_rig = world_T_rig @ pose(turn, step[3:])
    return world_T_rig


def step_motion(
    before_T_rigs: np.ndarray,
    world_T_rigs: np.ndarray,
    covariances: np.ndarray,
    joint: JointErrors,
) -> float:
    """Motion of the steps from frame to frame in their own standard deviations, rms: sqrt(mean(d^T
    C^-1 d) / 6) over all steps of known covariance C; NaN where there is none.

    Args:
        before_T_rigs, world_T_rigs: (F, 4, 4) poses before the round, in a world of any scale,
            and after it.
        covariances: (F, 6, 6) of these [rotation rad, translation], rig frames; NaN = not
            known.
    """
    steps, former = _steps(world_T_rigs), _steps(before_T_rigs)
    length, was = (np.linalg.norm(some[:, :3, 3], axis=1).sum() for some in (steps, former))
    former[:, :3, 3] *= length / max(was, 1e-300)
    motion = inverse(former) @ steps
    tangents = np.column_stack(
        [Rotation.from_matrix(motion[:, :3, :3]).as_rotvec(), motion[:, :3, 3]]
    )
    spread = step_covariances(world_T_rigs, covariances, joint.neighbours)
    known = np.isfinite(spread).all(axis=(1, 2))
    if not known.any():
        return np.nan
    # Radians and map units apart by orders of magnitude: each by its own standard deviation first.
    sigmas = np.sqrt(np.maximum(np.einsum("fii->fi", spread[known]), 1e-300))
    scaled = tangents[known] / sigmas
    correlations = spread[known] / (sigmas[:, :, None] * sigmas[:, None, :])
    inverses = np.linalg.pinv(correlations, hermitian=True)
    return float(np.sqrt(np.einsum("fi,fij,fj->f", scaled, inverses, scaled).mean() / 6))


def _steps(world_T_rigs: np.ndarray) -> np.ndarray:
    return inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
