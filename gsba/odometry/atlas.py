"""A small panorama as six overlapping pinhole faces side by side in one picture, its atlas, cut
along axes nearly fixed in the world; and features followed between two."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import KDTree

from factors.compiled import kernel_and_part
from gsba.camera.rig import RIG_R_FACE, CubeRig, cells_of, owner_faces
from gsba.camera.sphere import around_sphere
from gsba.geometry import rotation_angle, unit
from gsba.odometry.derotation import PAD
from gsba.odometry.lucas_kanade import LEVELS, WINDOW, align_patches, pyramid

_kernel, _part = kernel_and_part()
HFOV = np.deg2rad(106.0)  # of a face: a feature may move 8 degrees beyond the face that owns it
_COLUMNS = 3  # faces side by side
_MAX_CUT_ERROR = np.deg2rad(6.0)  # largest rotation of a cut's axes against the world: maps are
# computed anew beyond it
# Minimax polynomial of arctan(t) / t in t^2 on [0, 1] (Chebyshev nodes): error 7e-7 at most.
_A0, _A1, _A2, _A3, _A4, _A5, _A6 = (
    np.float32(a)
    for a in (
        *(0.999999328, -0.333263745, 0.198798722, -0.134804056, 0.0837415565, -0.0368986292),
        0.00782548295,
    )
)
_QUARTER, _HALF, _ONE_HALF = np.float32(np.pi / 2), np.float32(np.pi), np.float32(0.5)
_TINY = np.float32(1e-30)


@dataclass(frozen=True)
class Atlas:
    """One frame cut into faces."""

    image: np.ndarray  # (2 s, 3 s) uint8, faces of s pixels, FACES order row by row
    cut_R_rig: np.ndarray  # (3, 3) float64, axes of the cube of faces

    @cached_property
    def pyramid(self) -> tuple[np.ndarray, ...]:
        """The image and its halvings, float32."""
        return pyramid(self.image)


@dataclass(frozen=True)
class AtlasLayout:
    """Pixels of bearings in an atlas, and back."""

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
        """True (N,) for pixels (N, 2) in their face and at least `margin` pixels from its
        border."""
        local = pixels - self.corners[faces]
        with np.errstate(invalid="ignore"):
            within = (local > margin) & (local < self.rig.size - 1 - margin)
        return np.asarray(within.all(axis=1))


class Cutter:
    """Cuts frames along axes that stay within `_MAX_CUT_ERROR` of the world's."""

    def __init__(self, layout: AtlasLayout, cut_R_rig: np.ndarray | None = None) -> None:
        """A cutter for one layout; `cut_R_rig` (3, 3): axes of the cut before, if there was one."""
        self._layout = layout
        rays = layout.directions.reshape(-1, 3)
        self._rays = np.ascontiguousarray(rays.T, np.float32)
        self._height = 0
        self._maps: tuple[np.ndarray, np.ndarray] | None = None
        self.cut_R_rig = cut_R_rig  # axes of the last cut

    def cut(self, grey: np.ndarray, world_R_rig: np.ndarray, exactly: bool = False) -> Atlas:
        """The atlas of a panorama (h, 2h) uint8 whose orientation (3, 3) is roughly known; exactly:
        cut along these axes, not along others near them."""
        off = np.inf
        if self.cut_R_rig is not None:
            off = float(rotation_angle(self.cut_R_rig.T @ world_R_rig))
        if off > (1e-9 if exactly else _MAX_CUT_ERROR):
            self.cut_R_rig, self._maps = world_R_rig.copy(), None
        assert self.cut_R_rig is not None
        if self._maps is None or self._height != len(grey):
            self._height = len(grey)
            maps = np.empty_like(self._rays[:2])
            axes = self.cut_R_rig.astype(np.float32)
            _erp_pixels(*self._rays, axes, np.float32(len(grey)), *maps)
            across, down = (maps + np.float32(PAD)).reshape(2, *self._layout.directions.shape[:2])
            self._maps = cv2.convertMaps(across, down, cv2.CV_16SC2)
        assert self._maps is not None
        first, second = self._maps
        image = cv2.remap(around_sphere(grey, PAD), first, second, cv2.INTER_LINEAR)
        return Atlas(image, self.cut_R_rig)


@_part
def _arctangent(y, x):
    """Angle in (-pi, pi] of a vector (x, y), float32, to a millionth of a radian."""
    across, along = abs(y), abs(x)
    ratio = min(across, along) / max(max(across, along), _TINY)
    square = ratio * ratio
    angle = _A0 + square * (_A1 + square * (_A2 + square * (_A3 + square * (_A4 + square * _A5))))
    angle = ratio * (angle + _A6 * square * square * square * square * square * square)
    angle = _QUARTER - angle if across > along else angle
    angle = _HALF - angle if x < 0 else angle
    return -angle if y < 0 else angle


@_kernel
def _erp_pixels(xs, ys, zs, cut_R_rig, height, across, down):
    """OpenCV pixels of a panorama in directions of rays, axes of the cut; float32 throughout."""
    per_radian = height / _HALF
    half = _ONE_HALF
    for i in range(len(xs)):
        x, y, z = xs[i], ys[i], zs[i]
        a = cut_R_rig[0, 0] * x + cut_R_rig[1, 0] * y + cut_R_rig[2, 0] * z
        b = cut_R_rig[0, 1] * x + cut_R_rig[1, 1] * y + cut_R_rig[2, 1] * z
        c = cut_R_rig[0, 2] * x + cut_R_rig[1, 2] * y + cut_R_rig[2, 2] * z
        across[i] = height + per_radian * _arctangent(a, c) - half
        down[i] = half * height + per_radian * _arctangent(b, np.sqrt(a * a + c * c)) - half


_MAX_DIFFERENCE = 25.0  # largest mean difference of both patches, grey values


def follow(
    layout: AtlasLayout,
    template: Atlas,
    frame: Atlas,
    bearings_template: np.ndarray,
    predicted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Bearings (N, 3) of features in a frame's rig frame, and (N,) bool, True for found ones. Each
    is followed, forth and back, on the face that best shows both bearings.

    Args:
        template, frame: cut along nearly the same axes of the world.
        bearings_template, predicted: (N, 3) unit, in the template's rig frame, and predicted in
            the frame's.
    """
    before = bearings_template @ template.cut_R_rig.T
    guess = predicted @ frame.cut_R_rig.T
    faces = owner_faces(unit(before + guess)).astype(np.int64)
    starts, ends = layout.pixels(before, faces), layout.pixels(guess, faces)
    margin = WINDOW / 2 + 1
    rows = np.flatnonzero(layout.inside(starts, faces, margin) & layout.inside(ends, faces, margin))
    found, bearings = np.zeros(len(predicted), bool), predicted.copy()
    if not len(rows):
        return bearings, found
    given = starts[rows], ends[rows]
    there, forth, difference = align_patches(template.pyramid, frame.pyramid, *given, LEVELS)
    expected = starts[rows] + there - ends[rows]  # as far off as the guess was
    back, home, _ = align_patches(frame.pyramid, template.pyramid, there, expected, 1)
    off = np.linalg.norm(back - starts[rows], axis=1)
    good = forth & home & (off < 0.6) & (difference < _MAX_DIFFERENCE)  # pixels
    good &= layout.inside(there, faces[rows], margin)
    rows, there = rows[good], there[good]
    found[rows] = True
    bearings[rows] = layout.bearings(there, faces[rows]) @ frame.cut_R_rig
    return bearings, found


_PER_SIDE = 11  # cells along a side of a cube face, 8 degrees each
_BLOCK = 5  # pixels across the patch of which gradients are summed
_APART_PX = 5  # least distance between features
_MIN_EIGENVALUE = 3e-5  # least eigenvalue of a patch's gradients, in OpenCV's normalisation: less
# is noise


def new_corners(
    layout: AtlasLayout, atlas: Atlas, usable: np.ndarray | None, known: np.ndarray
) -> np.ndarray:
    """Bearings (N, 3), rig frame, of corners in cells with too few features, known so far at (M,
    3); usable: (2 s, 3 s) bool, pixels of the scene, None = all."""
    response = cv2.cornerMinEigenVal(atlas.image, _BLOCK)
    allowed = layout.owned if usable is None else layout.owned & usable
    # median response of the flattest quarter of a picture: that of noise, if walls are bare
    some = response[::4, ::4][allowed[::4, ::4]]
    flat = float(np.quantile(some, 0.125)) if len(some) else 0.0
    floor = max(_MIN_EIGENVALUE, 4.0 * flat)
    peaks = (response == cv2.dilate(response, np.ones((5, 5)))) & (response > floor) & allowed
    taken = np.zeros(6 * _PER_SIDE**2, int)
    if len(known):
        along = known @ atlas.cut_R_rig.T
        np.add.at(taken, cells_of(along, _PER_SIDE), 1)
        pixels = np.rint(layout.pixels(along, owner_faces(along).astype(np.int64)))
        for u, v in pixels.astype(int):
            top, left = max(v - _APART_PX, 0), max(u - _APART_PX, 0)
            peaks[top : v + _APART_PX + 1, left : u + _APART_PX + 1] = False
    v, u = np.nonzero(peaks)
    order = np.argsort(-response[v, u], kind="stable")
    v, u = v[order], u[order]
    faces = (v // layout.rig.size) * 3 + u // layout.rig.size
    bearings = layout.bearings(np.stack([u, v], axis=1).astype(float), faces)
    cells = cells_of(bearings, _PER_SIDE)
    room = 1 - taken
    ranked = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[ranked], np.arange(len(room)))
    rank = np.empty(len(cells), int)
    rank[ranked] = np.arange(len(cells)) - starts[cells[ranked]]
    kept = np.flatnonzero(rank < room[cells])  # features in a cell, including followed ones
    close = KDTree(np.stack([u, v], axis=1)[kept]).query_pairs(_APART_PX, output_type="ndarray")
    kept = np.delete(kept, close.max(axis=1))  # those near a stronger one
    return bearings[kept] @ atlas.cut_R_rig
