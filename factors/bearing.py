"""Bearing family: angle between a measured and a predicted direction, in the tangent plane.

The residual is the log map on the sphere at the measured bearing, a tangent 2-vector whose length
is the angle (0 to pi, never saturating). It does not depend on an image, so that it has no seam,
pole or face.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors._observations import BEARING, UNIT_TOLERANCE
from factors._terms import custom_factor, rig_vectors, whitener_rows

_MIN_SINE = 1e-12  # sine of the angle below which the residual's direction is undefined near pi


def tangent_basis(bearings: np.ndarray) -> np.ndarray:
    """Orthonormal axes, rows of (..., 2, 3) float64, of the tangent planes at unit bearings (...,
    3). Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6(1), 2017."""
    x, y, z = np.moveaxis(np.asarray(bearings, dtype=np.float64), -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    rows = [[1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def bearing_residuals(
    world_T_rigs: np.ndarray,
    points_world: np.ndarray,
    bearings_rig: np.ndarray,
    origins_rig: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tangent-plane residuals of bearings and their Jacobians.

    Args:
        world_T_rigs: (N, 4, 4) float64, pose that sees each observation.
        points_world: (N, 3) float64, world.
        bearings_rig: (N, 3) float64, unit, measured, rig frame.
        origins_rig: (N, 3) float64, rig frame, origin of each ray; None = the rig's centre.
            The Jacobian by them is minus that by the point, times world_R_rig.

    Returns:
        residuals (N, 2) in radians along `tangent_basis(bearings_rig)`, Jacobians by the pose
        (N, 2, 6) and by the point (N, 2, 3). Jacobians are zero exactly opposite the measurement;
        at the rig's centre, where no direction exists, the residual is (pi, 0) besides.
    """
    d, d_pose, d_point = rig_vectors(world_T_rigs, points_world, origins_rig)
    axes = tangent_basis(bearings_rig)
    xy = np.einsum("nij,nj->ni", axes, d)
    z = np.einsum("nj,nj->n", bearings_rig, d)
    s, squared = np.hypot(xy[:, 0], xy[:, 1]), np.einsum("ni,ni->n", d, d)
    length = np.sqrt(squared)
    angle = np.arctan2(s, z)
    centre = length == 0
    n2 = np.where(centre, 1.0, squared)
    regular = s > _MIN_SINE * length
    safe_s = np.where(regular, s, 1.0)
    ahead = np.where(z > 0, z, np.inf)
    f = np.where(regular, angle / safe_s, 1.0 / ahead)
    q = (s / ahead) ** 2
    series = -(2 / 3 - q * (4 / 5 - q * (6 / 7 - q * (8 / 9 - q * 10 / 11)))) / ahead**3
    k = np.where((z > 0) & (q < 1e-3), series, (z / n2 - f) / safe_s**2)
    residuals = f[:, None] * xy
    d_tangent = f[:, None, None] * np.eye(2) + k[:, None, None] * xy[:, :, None] * xy[:, None, :]
    by_d = d_tangent @ axes - (xy / n2[:, None])[:, :, None] * bearings_rig[:, None, :]
    opposite = ~regular & (z <= 0)
    residuals[opposite] = [np.pi, 0.0]
    by_d[opposite] = 0.0
    return residuals, by_d @ d_pose, by_d @ d_point


@dataclass(frozen=True, slots=True)
class BearingTerm:
    """Bearing observations of the landmarks of a block."""

    frames: np.ndarray  # (O,) int, row of the block's poses
    points: np.ndarray  # (O,) int, row of the block's landmarks
    bearings_rig: np.ndarray  # (O, 3) float64, unit, rig frame
    sigmas_rad: np.ndarray | float = 1.0  # () or (O,) radians, per axis
    sqrt_infos: np.ndarray | None = None  # (O, 2, 2) 1/rad on tangent_basis; replaces sigmas_rad
    name: str = "bearing"
    origins_rig: np.ndarray | None = None  # (O, 3) map units, rig frame: origin of each ray,
    # the centre of its lens; None = the rig\'s own centre

    kind = BEARING

    def measurements(self) -> np.ndarray:
        """(O, 3) rows as the kernels read them."""
        return np.asarray(self.bearings_rig, dtype=np.float64)

    def whiteners(self) -> np.ndarray:
        """(O, 3) upper triangles of the square-root information."""
        return whitener_rows(len(self.frames), self.sigmas_rad, self.sqrt_infos)

    def cameras(self) -> np.ndarray:
        """Empty: bearings have no faces, (0, 12)."""
        return np.zeros((0, 12))


def _one_bearing(bearing_rig: np.ndarray) -> np.ndarray:
    """A copy (1, 3) of a bearing. ValueError: it is not (3,), or not of length one."""
    bearing = np.array(bearing_rig, dtype=np.float64)
    if bearing.shape != (3,) or not abs(np.linalg.norm(bearing) - 1) <= UNIT_TOLERANCE:
        raise ValueError(f"a bearing must be (3,) and of length one, not {bearing}")
    return bearing[None]


def BearingFactor(
    pose_key: int, point_key: int, bearing_rig: np.ndarray, noise_model: gtsam.noiseModel.Base
) -> gtsam.CustomFactor:
    """One bearing observation as an ordinary GTSAM factor: the reference for the blocks.

    Args:
        pose_key, point_key: keys of a Pose3 `world_T_rig` and of a Point3.
        bearing_rig: (3,) unit, rig frame.
        noise_model: of dimension 2, radians on `tangent_basis(bearing_rig)`, robust or not.

    ValueError: the bearing is not of length one.
    """
    measured = _one_bearing(bearing_rig)

    def residual(world_T_rig: np.ndarray, point: np.ndarray):
        return bearing_residuals(world_T_rig, point, measured)

    return custom_factor(pose_key, point_key, noise_model, residual)


def LensBearingFactor(
    pose_key: int,
    point_key: int,
    centre_key: int,
    bearing_rig: np.ndarray,
    noise_model: gtsam.noiseModel.Base,
    sign: float = 1.0,
) -> gtsam.CustomFactor:
    """One bearing observed through a lens off the rig's centre: the reference for lens centres.

    Args:
        pose_key, point_key: keys of a Pose3 `world_T_rig` and of a Point3.
        centre_key: key of a Point3, the front lens's centre in the rig frame, map units.
        bearing_rig: (3,) unit, rig frame.
        noise_model: of dimension 2, radians on `tangent_basis(bearing_rig)`, robust or not.
        sign: 1 for the front lens, -1 for the opposite one.

    ValueError: the bearing is not of length one.
    """
    measured = _one_bearing(bearing_rig)

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        world_T_rig = values.atPose3(pose_key).matrix()[None]
        origin = sign * values.atPoint3(centre_key)[None]
        residuals, by_pose, by_point = bearing_residuals(
            world_T_rig, values.atPoint3(point_key)[None], measured, origin
        )
        if jacobians is not None:
            by_centre = -sign * by_point[0] @ world_T_rig[0, :3, :3]
            for n, jacobian in enumerate((by_pose[0], by_point[0], by_centre)):
                jacobians[n] = np.asfortranarray(jacobian)
        return residuals[0]

    return gtsam.CustomFactor(noise_model, [pose_key, point_key, centre_key], error)
