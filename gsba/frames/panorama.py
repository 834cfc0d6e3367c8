"""Grey panoramas of frames of any layout, for sampling on the sphere."""

import cv2
import numpy as np

from gsba.camera.equiangular import Grid, around_squares
from gsba.camera.rig import owner_faces
from gsba.camera.sphere import around_sphere, erp_bands, table
from gsba.camera.straighten import PAD
from gsba.frames.masks import load_usable
from gsba.frames.pixels import load_erp, load_faces
from gsba.frames.track_pairs import maps_of_panorama
from gsba.types import FACES, FrameSet, PictureFormat, rows_across


def width_for(kind: PictureFormat, max_width: int) -> int:
    """Width of the panoramas that `load_grey` makes of a camera's frames without enlarging them.

    A panorama of cube faces is at least as dense as these at their centres.
    """
    width = kind.panorama_width
    while width > max_width and width % 4 == 0:
        width //= 2
    return width


def load_grey(frames: FrameSet, frame: int, width: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Grey panorama of a frame and its mask.

    Args:
        width: pixels across, see `width_for`; narrower panoramas are enlarged.

    Returns:
        (width / 2, width) uint8 grey; (width / 2, width) bool or None, True = use.
    """
    kind = frames.format_of(frame)
    mask = load_usable(frames, frame)
    if kind.panoramic:
        grey = fitted_to(load_erp(frames, frame, gray=True, width=width), width)
        return grey, None if mask is None else fit_mask(mask, width)
    size = kind.width
    while size % 2 == 0 and 2 * size >= width:  # averaged down before they are joined
        size //= 2
    faces = np.zeros((len(FACES), size, size), np.uint8)
    present = [FACES.index(name) for name in kind.faces]
    faces[present] = load_faces(frames, frame, gray=True, size=size)
    joined = 4 * size
    u, v = maps_of_panorama(Grid(size, flat=True), joined)
    grey = cv2.remap(around_squares(faces, flat=True), u, v, cv2.INTER_CUBIC)
    usable = np.isin(_owners(joined), present)
    if mask is not None:
        usable &= fit_mask(mask, joined)
    whole = bool(usable.all())
    return fitted_to(grey, width), None if whole else fit_mask(usable, width)


class Greys:
    """Grey panoramas of frames that are read repeatedly: the first ones stay in memory.

    All have the width of the widest camera's.
    """

    def __init__(
        self, frames: FrameSet, max_width: int, limit_mb: float = 128.0, width: int | None = None
    ) -> None:
        self.num_frames = len(frames)
        self.width = width or max(width_for(kind, max_width) for kind in frames.formats)
        self._frames, self._limit_mb = frames, limit_mb
        self._room = int(limit_mb * 2**20 / self.width**2)  # images of width^2 / 2, and masks
        self._kept: dict[int, tuple[np.ndarray, np.ndarray | None]] = {}

    def __reduce__(self) -> tuple[object, ...]:  # workers read the pictures again
        return Greys, (self._frames, self.width, self._limit_mb, self.width)

    def taken(self, chosen: np.ndarray) -> "Greys":
        """The panoramas of some frames (F',), ascending, with paths for other processes."""
        frames = self._frames.taken(chosen, absolute=True)
        return Greys(frames, self.width, self._limit_mb, self.width)

    def enlargements(self) -> np.ndarray:
        """Factors (F,) float64, 1 or more, by which panoramas are larger than their frames."""
        own = np.array([kind.panorama_width for kind in self._frames.formats])
        return np.maximum(self.width / own, 1.0)[self._frames.cameras]

    def __getitem__(self, frame: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Panorama and mask like those of `load_grey`, from any thread."""
        found = self._kept.get(frame)
        if found is None:
            found = load_grey(self._frames, frame, self.width)
            if len(self._kept) < self._room:
                self._kept[frame] = found
        return found


def bright_level(greys: Greys) -> int:
    """Grey value that 99 % of the usable pixels of some frames do not exceed; 255 without any."""
    chosen = rows_across(greys.num_frames, 5)
    found = [greys[int(f)] for f in chosen]
    used = [(grey if mask is None else grey[mask]).ravel() for grey, mask in found]
    values = np.concatenate(used)
    return int(np.percentile(values, 99)) if len(values) else 255


def fitted_to(grey: np.ndarray, width: int) -> np.ndarray:
    """A panorama (h, 2h) uint8 averaged down to a width, or enlarged to it, (width / 2, width)."""
    if grey.shape[1] == width:
        return grey
    if grey.shape[1] < width:
        places = (np.arange(width) + 0.5) * (grey.shape[1] / width) - 0.5 + PAD
        u, v = np.meshgrid(places, places[: width // 2])
        maps = u.astype(np.float32), v.astype(np.float32)
        return cv2.remap(around_sphere(grey, PAD), *maps, cv2.INTER_CUBIC)
    return cv2.resize(grey, (width, width // 2), interpolation=cv2.INTER_AREA)


def fit_mask(mask: np.ndarray, width: int) -> np.ndarray:
    """A mask resized to a width; a pixel is usable if all pixels below it are."""
    if mask.shape[1] == width:
        return mask
    share = cv2.resize(mask.astype(np.float32), (width, width // 2), interpolation=cv2.INTER_AREA)
    return share > 0.999


@table(maxsize=2)
def _owners(width: int) -> np.ndarray:
    """Face (width / 2, width) uint8 that owns each pixel of a panorama."""
    owners = np.empty((width // 2, width), np.uint8)
    for rows, bearings in erp_bands(np.arange(width), width):
        owners[rows] = owner_faces(bearings)
    return owners
