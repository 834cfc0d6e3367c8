"""The cube rig: six concentric pinhole faces hanging on one frame."""

from dataclasses import dataclass

import numpy as np

from gsba.geometry import unit
from gsba.types import FACES

# Rows are the face's axes (right, down, forward) in the rig frame.
_FACE_R_RIG = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # front: +z
        [[0, 0, -1], [0, 1, 0], [1, 0, 0]],  # right: +x
        [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],  # back: -z
        [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],  # left: -x
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],  # up: -y
        [[1, 0, 0], [0, 0, -1], [0, 1, 0]],  # down: +y
    ],
    dtype=np.float64,
)
RIG_R_FACE = np.ascontiguousarray(np.swapaxes(_FACE_R_RIG, 1, 2))  # (6, 3, 3), FACES order


@dataclass(frozen=True, slots=True)
class CubeRig:
    """Square pinhole faces of `size` pixels seeing `hfov_rad`, one for each name in FACES."""

    size: int  # pixels
    hfov_rad: float  # field of view of a face, pi / 2 or a little more

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.size / np.tan(0.5 * self.hfov_rad)

    @property
    def principal(self) -> float:
        """Both coordinates of the principal point, pixels, corner origin."""
        return 0.5 * self.size

    def bearings(self, pixels: np.ndarray, faces: np.ndarray | int) -> np.ndarray:
        """Unit bearings (..., 3) in the rig frame of face pixels (..., 2), corner origin."""
        xy = (np.asarray(pixels, dtype=np.float64) - self.principal) / self.focal
        rays = unit(np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1))
        return np.einsum("...ij,...j->...i", RIG_R_FACE[faces], rays)

    def project(self, bearings_rig: np.ndarray, faces: np.ndarray | int) -> np.ndarray:
        """Face pixels (..., 2) of rig-frame vectors (..., 3); NaN where behind the face."""
        local = np.einsum("...ji,...j->...i", RIG_R_FACE[faces], bearings_rig)
        z = np.where(local[..., 2:] > 1e-9, local[..., 2:], np.nan)
        return self.focal * local[..., :2] / z + self.principal


def owner_faces(bearings_rig: np.ndarray) -> np.ndarray:
    """Index into FACES of the face that owns each bearing (..., 3): its largest component."""
    assert len(FACES) == 6
    return np.argmax(bearings_rig @ RIG_R_FACE[:, :, 2].T, axis=-1).astype(np.uint8)


def cells_of(bearings_rig: np.ndarray, per_side: int) -> np.ndarray:
    """Cell (N,) int64 of each bearing (N, 3): faces divided into as many equal angles a side."""
    faces = owner_faces(bearings_rig)
    local = np.einsum("kji,kj->ki", RIG_R_FACE[faces], bearings_rig)
    angles = np.arctan2(local[:, :2], local[:, 2:]) / (np.pi / 2) + 0.5
    across = np.clip((angles * per_side).astype(int), 0, per_side - 1)
    return (faces.astype(int) * per_side + across[:, 1]) * per_side + across[:, 0]


def witnesses(bearings_rig: np.ndarray, per_side: int) -> int:
    """Number of cells that bearings (N, 3) fall into; errors within one cell are correlated."""
    return int(np.count_nonzero(np.bincount(cells_of(bearings_rig, per_side))))
