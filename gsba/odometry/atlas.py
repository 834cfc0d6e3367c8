"""A small panorama as six overlapping pinhole faces side by side in one picture, its atlas.

Optical flow needs pictures without seam and poles. Frames are cut along axes that are nearly fixed
in the world, so that what a feature looks like does not turn when the camera does.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from factors.compiled import kernel_and_part
from gsba.camera.rig import RIG_R_FACE, CubeRig, owner_faces
from gsba.camera.sphere import around_sphere
from gsba.geometry import rotation_angle, unit

_kernel, _part = kernel_and_part()
HFOV = np.deg2rad(106.0)  # of a face: a feature may move 8 degrees beyond the face that owns it
_COLUMNS = 3  # faces side by side
_PAD = 2  # pixels beyond seam and poles that interpolation reads
_MAX_CUT_ERROR = np.deg2rad(6.0)  # of the axes of a cut: maps are computed anew beyond it


@dataclass(frozen=True)
class Atlas:
    """One frame cut into faces."""

    image: np.ndarray  # (2 s, 3 s) uint8, faces of s pixels, FACES order row by row
    cut_R_rig: np.ndarray  # (3, 3) float64, axes of the cube of faces


@dataclass(frozen=True)
class AtlasLayout:
    """Where bearings lie in an atlas."""

    rig: CubeRig  # faces of the cube

    @classmethod
    def of(cls, panorama_width: int) -> "AtlasLayout":
        """Faces as dense in their middle as a panorama of this width."""
        focal = panorama_width / (2 * np.pi)
        return cls(CubeRig(round(2 * focal * np.tan(HFOV / 2)), HFOV))

    @cached_property
    def corners(self) -> np.ndarray:
        """(6, 2) float64, pixel of the top left corner of each face."""
        number = np.arange(len(RIG_R_FACE))
        return self.rig.size * np.stack([number % _COLUMNS, number // _COLUMNS], axis=1).astype(
            float
        )

    @cached_property
    def directions(self) -> np.ndarray:
        """(2 s, 3 s, 3) float64, unit bearing of each pixel along the axes of the cut."""
        s = self.rig.size
        v, u = np.mgrid[:s, :s] + 0.5
        out = np.empty((2 * s, _COLUMNS * s, 3))
        for face, (left, top) in enumerate(self.corners.astype(int)):
            out[top : top + s, left : left + s] = self.rig.bearings(np.stack([u, v], -1), face)
        return out

    @cached_property
    def owned(self) -> np.ndarray:
        """(2 s, 3 s) bool, pixels whose face owns their bearing."""
        s = self.rig.size
        owners = owner_faces(self.directions)
        faces = np.arange(6).reshape(2, _COLUMNS).repeat(s, axis=0).repeat(s, axis=1)
        return owners == faces

    def pixels(self, bearings_cut: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """OpenCV pixels (N, 2) of bearings (N, 3), axes of the cut; NaN behind the face."""
        return self.rig.project(bearings_cut, faces) + self.corners[faces] - 0.5

    def bearings(self, pixels: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Unit bearings (N, 3) along the axes of the cut of OpenCV pixels (N, 2)."""
        return self.rig.bearings(pixels + 0.5 - self.corners[faces], faces)

    def inside(self, pixels: np.ndarray, faces: np.ndarray, margin: float) -> np.ndarray:
        """Which pixels (N, 2) are in their face and `margin` pixels from its border, (N,) bool."""
        local = pixels - self.corners[faces]
        with np.errstate(invalid="ignore"):
            within = (local > margin) & (local < self.rig.size - 1 - margin)
        return np.asarray(within.all(axis=1))


class Cutter:
    """Cuts frames along axes that stay within `_MAX_CUT_ERROR` of those of the world."""

    def __init__(self, layout: AtlasLayout) -> None:
        self._layout = layout
        self._cut_R_rig: np.ndarray | None = None
        self._height = 0
        self._maps: tuple[np.ndarray, np.ndarray] | None = None

    def cut(self, grey: np.ndarray, world_R_rig: np.ndarray) -> Atlas:
        """The atlas of a panorama (h, 2h) uint8 whose orientation is roughly known.

        Args:
            grey: the panorama.
            world_R_rig: (3, 3) predicted orientation.
        """
        off = np.inf
        if self._cut_R_rig is not None and self._height == len(grey):
            off = float(rotation_angle(self._cut_R_rig.T @ world_R_rig))
        if off > _MAX_CUT_ERROR:
            self._cut_R_rig, self._height = world_R_rig.copy(), len(grey)
            rays = self._layout.directions.reshape(-1, 3)
            maps = np.empty((*self._layout.directions.shape[:2], 2), np.float32)
            _erp_pixels(rays, world_R_rig, len(grey), maps.reshape(-1, 2))
            maps += _PAD
            self._maps = cv2.convertMaps(maps, np.zeros(0, np.float32), cv2.CV_16SC2)
        assert self._cut_R_rig is not None and self._maps is not None
        first, second = self._maps
        image = cv2.remap(around_sphere(grey, _PAD), first, second, cv2.INTER_LINEAR)
        return Atlas(image, self._cut_R_rig)


def shared_faces(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Face (N,) that shows best a feature seen along two bearings (N, 3), axes of the cut."""
    return owner_faces(unit(one + other)).astype(np.int64)


@_kernel
def _erp_pixels(rays, cut_R_rig, height, out):
    """OpenCV pixels (N, 2) of a panorama that rays (N, 3) along the axes of a cut meet."""
    per_radian = height / np.pi
    for i in range(len(rays)):
        x, y, z = rays[i]
        a = cut_R_rig[0, 0] * x + cut_R_rig[1, 0] * y + cut_R_rig[2, 0] * z
        b = cut_R_rig[0, 1] * x + cut_R_rig[1, 1] * y + cut_R_rig[2, 1] * z
        c = cut_R_rig[0, 2] * x + cut_R_rig[1, 2] * y + cut_R_rig[2, 2] * z
        out[i, 0] = height + per_radian * np.arctan2(a, c) - 0.5
        out[i, 1] = 0.5 * height + per_radian * np.arctan2(b, np.sqrt(a * a + c * c)) - 0.5
