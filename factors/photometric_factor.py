"""Photometric family, one observation at a time: the reference for the block.

A patch of one frame, its grey values without mean over their contrast, is compared with the
patch in another frame, normalised likewise: gain and offset between both cancel.
"""

from typing import Protocol

import gtsam
import numpy as np


class Sampled(Protocol):
    """An image on the sphere: a `SphereImage`, or one with its interface."""

    def sample(self, vectors_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (...) and gradients (..., 3) along vectors (..., 3)."""
        ...


def normalised(values: np.ndarray, floor: float) -> tuple[np.ndarray, float]:
    """Grey values (N,) without mean over their contrast, and that contrast's norm; floor: grey
    values added to the contrast in quadrature, so that flat patches stay near zero."""
    centred = values - values.mean()
    norm = float(np.sqrt(centred @ centred + len(values) * floor**2))
    return centred / norm, norm


def photometric_residuals(
    world_T_host: np.ndarray,
    world_T_target: np.ndarray,
    plane: np.ndarray,
    axes: np.ndarray,
    grid: np.ndarray,
    template: np.ndarray,
    image: Sampled,
    floor: float = 0.25,
    rig_T_host: np.ndarray | None = None,
    rig_T_target: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residual of each pixel of a patch in one target, in grey values of the host's patch.

    Args:
        world_T_host, world_T_target: (4, 4) float64.
        plane: (3,) inverse depth and slopes, see `factors.patch_windows.PatchTable`.
        axes: (3, 3) bearing and tangent axes, see `factors.patch_windows.patch_axes`.
        grid: (N, 2) tangents of the pixels.
        template: (N,) grey values in the host.
        floor: see `normalised`.
        rig_T_host, rig_T_target: (4, 4) of the lens that shows the patch; None = the rig itself.

    Returns:
        residuals (N,), Jacobians by the host's pose (N, 6), the target's pose (N, 6), both right
        perturbations [rotation, translation], and by the plane (N, 3).
    """
    wanted, contrast = normalised(template, floor)
    weights = np.column_stack([np.ones(len(grid)), grid])
    of_host, of_target = (
        gtsam.Pose3(np.eye(4) if view is None else view) for view in (rig_T_host, rig_T_target)
    )
    target_T_host = (
        gtsam.Pose3(world_T_target)
        .compose(of_target)
        .between(gtsam.Pose3(world_T_host).compose(of_host))
        .matrix()
    )
    A, c = target_T_host[:3, :3], target_T_host[:3, 3]
    rays = weights @ axes  # in the host's rig frame
    turned, near = rays @ A.T, weights @ plane
    directions = turned + near[:, None] * c
    values, slopes = image.sample(directions)
    seen, norm = normalised(values, floor)

    def through(by_pixel: np.ndarray) -> np.ndarray:
        centred = by_pixel - by_pixel.mean(axis=0)
        return contrast / norm * (centred - np.outer(seen, seen @ centred))

    by_host = np.hstack([np.cross(rays, slopes @ A), near[:, None] * (slopes @ A)])
    by_target = np.hstack([np.cross(slopes, directions), -near[:, None] * slopes])
    by_plane = (slopes @ c)[:, None] * weights
    by_host = by_host @ of_host.inverse().AdjointMap()
    by_target = by_target @ of_target.inverse().AdjointMap()
    return contrast * (seen - wanted), through(by_host), through(by_target), through(by_plane)


def PhotometricFactor(
    host_key: int,
    target_key: int,
    plane_key: int,
    axes: np.ndarray,
    grid: np.ndarray,
    template: np.ndarray,
    image: Sampled,
    noise_model: gtsam.noiseModel.Base,
    slopes: np.ndarray | None = None,
    floor: float = 0.25,
    rig_T_host: np.ndarray | None = None,
    rig_T_target: np.ndarray | None = None,
) -> gtsam.CustomFactor:
    """One patch in one target as an ordinary GTSAM factor.

    Args:
        host_key, target_key: keys of Pose3 `world_T_rig`.
        plane_key: key of a Point3, the plane (inverse depth and slopes), or, where `slopes` are
            given, of a double, the inverse depth alone.
        axes, grid, template, image, floor, rig_T_host, rig_T_target: as for
            `photometric_residuals`.
        noise_model: of dimension N, grey values, robust or not.
        slopes: (2,) of the plane per inverse depth, held fixed; zeros face the host.
    """
    shape = None if slopes is None else np.concatenate([[1.0], slopes])

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        plane = values.atPoint3(plane_key) if shape is None else values.atDouble(plane_key) * shape
        residuals, by_host, by_target, by_plane = photometric_residuals(
            values.atPose3(host_key).matrix(), values.atPose3(target_key).matrix(), plane, axes,
            grid, template, image, floor, rig_T_host, rig_T_target,
        )  # fmt: skip
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_host)
            jacobians[1] = np.asfortranarray(by_target)
            chained = by_plane if shape is None else by_plane @ shape[:, None]
            jacobians[2] = np.asfortranarray(chained)
        return residuals

    return gtsam.CustomFactor(noise_model, [host_key, target_key, plane_key], error)
