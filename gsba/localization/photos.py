"""Perspective photos: what their tags say of the camera, and their pixels as faces of a rig."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.projections import PerspectiveProjection
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_bands
from gsba.features.detection import Extractor, extract
from gsba.frames.exif import read_exif
from gsba.frames.files import decode, image_size
from gsba.geometry import unit
from gsba.log import GsbaError
from gsba.types import FACES, Features

_MAX_FIELD_RAD = np.deg2rad(170.0)  # across a photo's diagonal by its tags
_PRINCIPAL_SIGMA = 0.01  # in focal lengths
_MARGIN_PX = 2.0  # of a photo's border that is not sampled


@dataclass(frozen=True, slots=True)
class Photo:
    """A perspective photo, without pixels."""

    name: str  # without folder and extension
    path: Path
    width: int  # pixels, as shown
    height: int  # pixels, as shown
    focal: float | None  # pixels, by its tags; None = not known
    camera: str  # photos of one text share a camera's parameters

    def load(self) -> np.ndarray:
        """Pixels (H, W, 3) uint8 RGB; GsbaError if the file cannot be read."""
        return decode(self.path, (self.width, self.height))

    def projection(self, focal: float) -> PerspectiveProjection:
        """The projection without distortion, its principal point in the middle."""
        middle = self.width / 2, self.height / 2
        return PerspectiveProjection(self.width, self.height, focal, middle, (0.0, 0.0))

    def prior_sigmas(self) -> np.ndarray:
        """Standard deviations (5,) of the prior on the projection's parameters."""
        # Makers round focal lengths to millimetres, and crop what they film.
        focal = 0.5 if self.focal is None else 0.05
        return np.array([focal, _PRINCIPAL_SIGMA, _PRINCIPAL_SIGMA, 0.1, 0.05])


def read_photo(path: Path) -> Photo:
    """A photo by its header and its tags. Photos share a camera if these name the same maker,
    model, lens and focal length, and they have one size; without tags each has its own. GsbaError
    if damaged."""
    width, height = image_size(path)
    try:
        tags = read_exif(path)
    except ValueError:  # damaged tags tell nothing
        return Photo(path.stem, path, width, height, None, str(path))
    focal = None
    if np.isfinite(tags.focal_35mm):
        pixels = tags.focal_35mm / float(np.hypot(36.0, 24.0)) * float(np.hypot(width, height))
        if 2 * np.arctan(np.hypot(width, height) / 2 / pixels) < _MAX_FIELD_RAD:
            focal = pixels
    known = tags.camera and focal is not None
    named = f"{tags.camera}, {tags.lens}, {tags.focal_35mm:g} mm, {width}x{height}"
    return Photo(path.stem, path, width, height, focal, named if known else str(path))


def photo_rig(projection: PerspectiveProjection, rig: CubeRig) -> CubeRig:
    """Faces for a photo: as dense as it, between one and two times the run's."""
    # in pixel densities of the run's faces
    density = min(max(projection.focal / rig.focal, 1.0), 2.0)
    return CubeRig(round(density * rig.size), rig.hfov_rad)


def photo_features(
    image: np.ndarray, projection: PerspectiveProjection, rig: CubeRig, extractor: Extractor
) -> Features:
    """Keypoints of a photo (H, W, 3) uint8 RGB on faces around its camera, where it looks to the
    extractor as panoramas do, bearings as the projection has them."""
    faces = np.zeros((len(FACES), rig.size, rig.size, 3), np.uint8)
    masks = np.zeros((len(FACES), rig.size, rig.size), bool)
    image, scales = _as_dense_as(image, projection, rig.focal)
    centres = np.arange(rig.size) + 0.5
    grid = np.stack(np.meshgrid(centres, centres), axis=-1)
    for face in range(len(FACES)):
        pixels, inside = _pixels_of(rig.bearings(grid, face), projection)
        if inside.any():
            faces[face], masks[face] = _sampled(image, scales, pixels), inside
    if not masks.any():
        raise GsbaError("a photo shows nothing within its field of view")
    return extract(faces, masks, rig, extractor)


def as_panorama(
    image: np.ndarray, projection: PerspectiveProjection, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Grey panorama (width / 2, width) uint8 that holds a photo (H, W, 3) uint8 RGB, and its
    mask."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grey, scales = _as_dense_as(grey, projection, width / (2 * np.pi))
    out = np.zeros((width // 2, width), np.uint8)
    mask = np.zeros(out.shape, bool)
    for rows, bearings in erp_bands(np.arange(width), width):
        pixels, inside = _pixels_of(bearings, projection)
        if inside.any():
            out[rows], mask[rows] = _sampled(grey, scales, pixels), inside
    return out, mask


def shows(projection: PerspectiveProjection, points: np.ndarray) -> np.ndarray:
    """True (N,) for points (N, 3) of a photo's frame that lie within it."""
    return _pixels_of(unit(points), projection)[1]


def _pixels_of(
    bearings: np.ndarray, projection: PerspectiveProjection
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) of bearings (..., 3), and True (...) where the photo shows them."""
    ahead = bearings[..., 2] > 0.02
    pixels = projection.project(np.where(ahead[..., None], bearings, [0.0, 0.0, 1.0]))
    size = np.array([projection.width, projection.height], np.float64)
    inside = ahead & (pixels > _MARGIN_PX).all(axis=-1) & (pixels < size - _MARGIN_PX).all(axis=-1)
    # Angle from the axis up to which distortion carries rays outward, and into the picture
    angles = np.linspace(0, _MAX_FIELD_RAD / 2, 500)
    radii, slopes = projection.radii(angles)
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - np.array(projection.principal)
    furthest = float(np.linalg.norm(corners, axis=1).max()) / projection.focal
    # a radius that grows by less than .1 focal lengths per radian folds the picture
    shown = np.logical_and.accumulate((slopes > 0.1) & (radii <= furthest))
    inside &= bearings[..., 2] > np.cos(float(angles[shown].max(initial=0.0)) + angles[1])
    return np.where(inside[..., None], pixels, 0.0), inside


def _as_dense_as(
    image: np.ndarray, projection: PerspectiveProjection, focal: float
) -> tuple[np.ndarray, np.ndarray]:
    """A photo averaged down to about a focal length (pixels), and the factors (2,) of its sides."""
    scale = focal / projection.focal
    if scale > 1 / 1.5:
        return image, np.ones(2)
    size = np.array([image.shape[1], image.shape[0]])
    small = np.maximum(np.rint(scale * size), 1).astype(int)
    return cv2.resize(image, small.tolist(), interpolation=cv2.INTER_AREA), small / size


def _sampled(image: np.ndarray, scales: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values of a photo, averaged down by factors (2,), at pixels (h, w, 2) of the original."""
    at = (scales * pixels - 0.5).astype(np.float32)
    border = cv2.BORDER_REPLICATE
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=border)
