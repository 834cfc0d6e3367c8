"""Motion of poses by a round of adjustment, in their own standard deviations."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse, step_covariances
from gsba.types import JointErrors


def step_motion(
    before_T_rigs: np.ndarray,
    world_T_rigs: np.ndarray,
    covariances: np.ndarray,
    joint: JointErrors,
) -> float:
    """Motion of the steps from frame to frame in their own standard deviations, rms.

    Args:
        before_T_rigs: (F, 4, 4) poses before the round, in a world of any scale.
        world_T_rigs: (F, 4, 4) poses after it.
        covariances: (F, 6, 6) of these [rotation rad, translation], rig frames; NaN = not known.
        joint: what errors of neighbours have in common.

    Returns:
        sqrt(mean(d^T C^-1 d) / 6) over all steps of known covariance C; NaN where there is none.
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
