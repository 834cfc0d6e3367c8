"""Reprojection family: pixels on the pinhole faces of a rig, through world_T_rig * rig_R_face."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors._observations import MIN_DEPTH, REPROJECTION
from factors._terms import custom_factor, rig_vectors, whitener_rows


@dataclass(frozen=True, slots=True)
class FaceCameras:
    """The pinhole faces of a rig; all share its centre. ValueError: arrays of unequal lengths, not
    finite, or focal lengths that are not positive."""

    rig_R_faces: np.ndarray  # (C, 3, 3) float64, face axes x right, y down, z forward
    focals: np.ndarray  # (C,) float64, pixels
    principals: np.ndarray  # (C, 2) float64, (u, v) pixels, corner origin

    def __post_init__(self) -> None:
        num = len(self.rig_R_faces)
        shapes = (num, 3, 3), (num,), (num, 2)
        arrays = self.rig_R_faces, self.focals, self.principals
        if tuple(map(np.shape, arrays)) != shapes:
            raise ValueError(
                f"rotations, focal lengths and principal points of {num} faces must be {shapes}, "
                f"not {tuple(map(np.shape, arrays))}"
            )
        if not (all(np.isfinite(a).all() for a in arrays) and np.all(np.greater(self.focals, 0))):
            raise ValueError("face cameras must be finite, and their focal lengths positive")

    def rows(self) -> np.ndarray:
        """(C, 12) rows as the kernels read them."""
        num = len(self.rig_R_faces)
        flat = np.reshape(self.rig_R_faces, (num, 9)).astype(np.float64)
        return np.column_stack([flat, self.focals, self.principals])


def reprojection_residuals(
    world_T_rigs: np.ndarray,
    points_world: np.ndarray,
    pixels: np.ndarray,
    faces: np.ndarray,
    cameras: FaceCameras,
    origins_rig: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixel residuals (predicted minus measured) and their Jacobians.

    Args:
        world_T_rigs: (N, 4, 4) float64, pose that sees each observation.
        points_world: (N, 3) float64, world.
        pixels: (N, 2) float64, measured (u, v), corner origin.
        faces: (N,) int, row of `cameras`.
        origins_rig: (N, 3) float64, rig frame, origin of each ray; None = the rig's centre.

    Returns:
        residuals (N, 2) pixels, Jacobians by the pose (N, 2, 6) and by the point (N, 2, 3), and
        `in_front (N,)` bool. Behind its face a point gets zero Jacobians and the constant
        residual (2 focal, 2 focal), as in GTSAM's projection factors.
    """
    d, d_pose, d_point = rig_vectors(world_T_rigs, points_world, origins_rig)
    face_R_rigs = np.swapaxes(np.asarray(cameras.rig_R_faces, dtype=np.float64)[faces], 1, 2)
    focals = np.asarray(cameras.focals, dtype=np.float64)[faces]
    local = np.einsum("nij,nj->ni", face_R_rigs, d)
    in_front = local[:, 2] > MIN_DEPTH * np.hypot(local[:, 0], local[:, 1])
    z = np.where(in_front, local[:, 2], 1.0)
    scale = focals / z
    residuals = scale[:, None] * local[:, :2] + np.asarray(cameras.principals)[faces] - pixels
    by_local = np.zeros((len(d), 2, 3))
    by_local[:, 0, 0] = by_local[:, 1, 1] = scale
    by_local[:, :, 2] = -(scale / z)[:, None] * local[:, :2]
    residuals[~in_front] = 2 * focals[~in_front, None]
    by_local[~in_front] = 0.0
    by_d = by_local @ face_R_rigs
    return residuals, by_d @ d_pose, by_d @ d_point, in_front


@dataclass(frozen=True, slots=True)
class ReprojectionTerm:
    """Pixel observations of the landmarks of a block."""

    frames: np.ndarray  # (O,) int, row of the block's poses
    points: np.ndarray  # (O,) int, row of the block's landmarks
    pixels: np.ndarray  # (O, 2) float64, (u, v) on the face, corner origin
    faces: np.ndarray  # (O,) int, row of face_cameras
    face_cameras: FaceCameras
    sigmas_px: np.ndarray | float = 1.0  # () or (O,) pixels, per axis
    sqrt_infos: np.ndarray | None = None  # (O, 2, 2) 1/pixel; replaces sigmas_px
    name: str = "reprojection"
    origins_rig: np.ndarray | None = None  # (O, 3) map units, rig frame: origin of each ray,
    # the centre of its lens; None = the rig\'s own centre

    kind = REPROJECTION

    def measurements(self) -> np.ndarray:
        """(O, 3) rows as the kernels read them."""
        return np.column_stack([self.pixels, self.faces]).astype(np.float64)

    def whiteners(self) -> np.ndarray:
        """(O, 3) upper triangles of the square-root information."""
        return whitener_rows(len(self.frames), self.sigmas_px, self.sqrt_infos)

    def cameras(self) -> np.ndarray:
        """(C, 12) rows of the face cameras."""
        return self.face_cameras.rows()


def ReprojectionFactor(
    pose_key: int,
    point_key: int,
    pixel: np.ndarray,
    face: int,
    cameras: FaceCameras,
    noise_model: gtsam.noiseModel.Base,
) -> gtsam.CustomFactor:
    """One pixel observation as an ordinary GTSAM factor: the reference for the blocks.

    Args:
        pose_key, point_key: keys of a Pose3 `world_T_rig` and of a Point3.
        pixel: (2,) measured (u, v) on the face, corner origin.
        face: row of `cameras`.
        noise_model: of dimension 2, pixels, robust or not.

    ValueError: there is no such face.
    """
    measured = np.array(pixel, dtype=np.float64)[None]
    if not 0 <= face < len(cameras.focals):
        raise ValueError(f"face {face} is out of range 0..{len(cameras.focals) - 1}")

    def residual(world_T_rig: np.ndarray, point: np.ndarray):
        return reprojection_residuals(world_T_rig, point, measured, np.array([face]), cameras)[:3]

    return custom_factor(pose_key, point_key, noise_model, residual)
