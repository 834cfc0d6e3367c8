"""Functions shared by the observation families: geometry, whitening, the reference factor."""

from collections.abc import Callable, Sequence

import gtsam
import numpy as np


def rig_vectors(
    world_T_rigs: np.ndarray, points_world: np.ndarray, origins_rig: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 3) seen from their rigs (N, 4, 4), `d = world_R_rig^T (X - rig_in_world) -
    origin`, by which the Jacobian by origins is minus one.

    Returns:
        d (N, 3) in the rig frame, its Jacobians by the pose (N, 3, 6), a right perturbation
        [rotation, translation], and by the point (N, 3, 3).
    """
    rig_R_world = np.swapaxes(world_T_rigs[:, :3, :3], 1, 2)
    d = np.einsum("nij,nj->ni", rig_R_world, points_world - world_T_rigs[:, :3, 3])
    by_pose = np.zeros((len(d), 3, 6))
    by_pose[:, 0, 1], by_pose[:, 0, 2] = -d[:, 2], d[:, 1]
    by_pose[:, 1, 0], by_pose[:, 1, 2] = d[:, 2], -d[:, 0]
    by_pose[:, 2, 0], by_pose[:, 2, 1] = -d[:, 1], d[:, 0]
    by_pose[:, :, 3:] = -np.eye(3)
    return d if origins_rig is None else d - origins_rig, by_pose, rig_R_world


def pose_rows(values: gtsam.Values, keys: Sequence[int]) -> np.ndarray:
    """(F, 12) float64 rows [world_R_rig row-major, rig_in_world] of Pose3 variables."""
    out = np.empty((len(keys), 12))
    for row, key in zip(out, keys, strict=True):
        matrix = values.atPose3(key).matrix()
        row[:9] = matrix[:3, :3].ravel()
        row[9:] = matrix[:3, 3]
    return out


def matrix_rows(a_T_bs: np.ndarray) -> np.ndarray:
    """Pose rows (N, 12) of transforms (N, 4, 4)."""
    return np.hstack([a_T_bs[:, :3, :3].reshape(-1, 9), a_T_bs[:, :3, 3]])


def moved_rows(rows: np.ndarray, views: np.ndarray) -> np.ndarray:
    """Rows (N, 12) of poses, each composed with the transform of a row of views (N, 12)."""
    turns, own = rows[:, :9].reshape(-1, 3, 3), views[:, :9].reshape(-1, 3, 3)
    moved = np.einsum("nij,nj->ni", turns, views[:, 9:]) + rows[:, 9:]
    return np.hstack([np.einsum("nij,njk->nik", turns, own).reshape(-1, 9), moved])


def whitener_rows(
    num: int, sigmas: np.ndarray | float, sqrt_infos: np.ndarray | None
) -> np.ndarray:
    """Upper triangles (O, 3) `[s00, s01, s11]` of 2x2 square-root information matrices.

    Any square root S of the information is allowed; it is replaced by the triangular one with equal
    S^T S, which changes no cost.
    """
    rows = np.zeros((num, 3))
    if sqrt_infos is None:
        sigmas = np.asarray(sigmas, dtype=np.float64)
        if not np.all(np.isfinite(sigmas) & (sigmas > 0)):
            raise ValueError("sigmas must be positive and finite")
        rows[:, 0] = rows[:, 2] = 1.0 / sigmas
        return rows
    roots = np.asarray(sqrt_infos, dtype=np.float64)
    if roots.shape != (num, 2, 2) or not np.all(np.isfinite(roots)):
        raise ValueError(f"sqrt_infos must be finite, ({num}, 2, 2), not {roots.shape}")
    x, y = roots[:, :, 0], roots[:, :, 1]
    rows[:, 0] = np.hypot(x[:, 0], x[:, 1])
    rows[:, 1] = (x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1]) / np.maximum(rows[:, 0], 1e-300)
    lengths = y[:, 0] ** 2 + y[:, 1] ** 2
    rows[:, 2] = np.sqrt(np.maximum(lengths - rows[:, 1] ** 2, 0.0))
    return rows


def custom_factor(
    pose_key: int,
    point_key: int,
    noise_model: gtsam.noiseModel.Base,
    residual: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> gtsam.CustomFactor:
    """Factor on a Pose3 and a Point3 from `residual(world_T_rigs (1, 4, 4), points (1, 3))`."""

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        world_T_rig = values.atPose3(pose_key).matrix()[None]
        residuals, by_pose, by_point = residual(world_T_rig, values.atPoint3(point_key)[None])
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_pose[0])
            jacobians[1] = np.asfortranarray(by_point[0])
        return residuals[0]

    return gtsam.CustomFactor(noise_model, [pose_key, point_key], error)
