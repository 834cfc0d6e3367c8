"""The outline of the carrier, from its certain pixels and the colours of the picture.

Fixed structure (`gsba.masks.fixed_structure`) marks the carrier except for its plain parts, and
exceeds its outline by the window of the comparison. Its core and certainly moving pixels seed a
graph cut on the median picture, in which the world is blurred (Rother, Kolmogorov, Blake, GrabCut,
SIGGRAPH 2004). Plain parts that the carrier encloses belong to it.
"""

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsba.camera.sphere import around_sphere
from gsba.masks.fixed_structure import FixedStructure, median_picture

_PADDING_PX = 32  # pixels around the sphere
_MIN_CERTAIN_STRONG, _MIN_CERTAIN_WEAK = 0.75, 0.6  # least strong and weak correlations that only a
# carrier has, see docs/masks.md
_MIN_LIKELY_WEAK = 0.2  # least weak correlation of pixels joined to certain ones
_SPILL_PX = 6  # pixels by which fixed structure exceeds the outline


def certain_places(structure: FixedStructure) -> np.ndarray:
    """True (h, 2h) where structure is fixed in both directions, at the size of `structure`."""
    return (structure.strong > _MIN_CERTAIN_STRONG) & (structure.weak > _MIN_CERTAIN_WEAK)


def outline_carrier(
    pictures: np.ndarray, median: np.ndarray, structure: FixedStructure
) -> np.ndarray:
    """The carrier's pixels, (h, 2h) bool; all False without a carrier, in panoramas (K, h, 2h, 3)
    uint8 in which it does not move, their median, and their fixed structure, smaller."""
    height, width = pictures.shape[1:3]
    nothing = np.zeros((height, width), bool)
    if not certain_places(structure).any():
        return nothing
    sure, strong, weak = (
        cv2.resize(x.astype(np.float32), (width, height))
        for x in (certain_places(structure), structure.strong, structure.weak)
    )
    likely = (strong > _MIN_CERTAIN_STRONG) | (
        (strong > _MIN_LIKELY_WEAK) & (weak > _MIN_LIKELY_WEAK)
    )
    likely = _parts_with(likely, sure > 0.5)
    core = _shrunk(likely, _SPILL_PX)
    if not core.any():
        return nothing
    rows = np.array_split(np.arange(len(median)), 8)  # little memory at a time
    parts = [np.abs(pictures[:, r].astype(np.int16) - median[r]).mean(axis=-1) for r in rows]
    change = np.concatenate([median_picture(part) for part in parts]).astype(np.float32)
    own_change = max(float(np.median(change[core])), 1.0)  # grey levels, at least
    moves = (_filtered_on_sphere(cv2.GaussianBlur, change, (0, 0), 1.0) > 3.0 * own_change) & ~core
    distance = _filtered_on_sphere(cv2.distanceTransform, ~likely, cv2.DIST_L2, 5)
    far = distance > 28  # pixels
    inside = _enclosed(~far)
    labels = np.full(core.shape, cv2.GC_PR_BGD, np.uint8)
    labels[inside | _shrunk(likely, _SPILL_PX // 2)] = cv2.GC_PR_FGD
    labels[(far & ~inside) | moves] = cv2.GC_BGD
    labels[core] = cv2.GC_FGD
    smooth = _filtered_on_sphere(cv2.GaussianBlur, median, (0, 0), 1.0, crop=False)
    padded = around_sphere(labels, _PADDING_PX)
    nowhere, models = (0, 0, 0, 0), (np.zeros((1, 65)), np.zeros((1, 65)))
    cv2.setRNGSeed(0)
    cv2.grabCut(smooth, padded, nowhere, *models, 2, cv2.GC_INIT_WITH_MASK)
    found = _parts_with(
        np.isin(
            padded[_PADDING_PX:-_PADDING_PX, _PADDING_PX:-_PADDING_PX], (cv2.GC_FGD, cv2.GC_PR_FGD)
        ),
        core,
    )
    plain = _enclosed(found)
    found |= plain & ~_parts_with(plain, moves, least=0.5)
    # one pixel more: features on the carrier's blurred rim are useless
    return _filtered_on_sphere(cv2.dilate, found, np.ones((3, 3), np.uint8)) > 0


def _shrunk(places: np.ndarray, pixels: int) -> np.ndarray:
    return _filtered_on_sphere(cv2.erode, places, np.ones((3, 3), np.uint8), iterations=pixels) > 0


def _filtered_on_sphere(
    work, image: np.ndarray, *arguments, crop: bool = True, **options
) -> np.ndarray:
    """Apply an OpenCV filter to an image (h, 2h[, C]), continued beyond seam and poles."""
    image = image.astype(np.uint8) if image.dtype == bool else image
    done = work(around_sphere(image, _PADDING_PX), *arguments, **options)
    return done[_PADDING_PX:-_PADDING_PX, _PADDING_PX:-_PADDING_PX] if crop else done


def _parts_with(places: np.ndarray, marks: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Connected parts of places (h, w) bool with more than this share of marks (h, w) bool."""
    labels = _label(places)
    shares = np.bincount(labels.ravel(), marks.ravel()) / np.maximum(np.bincount(labels.ravel()), 1)
    return places & (shares > least)[labels]


def _enclosed(found: np.ndarray) -> np.ndarray:
    """Holes (h, w) bool: all but the largest connected part of pixels outside `found`."""
    labels = _label(~found)
    sizes = np.bincount(labels[~found], minlength=1)
    return ~found & (labels != np.argmax(sizes))


def _label(places: np.ndarray) -> np.ndarray:
    """Number (h, 2h) of the connected part on the sphere that each place belongs to."""
    number, labels = cv2.connectedComponents(places.astype(np.uint8), connectivity=4)
    pairs = [(labels[:, 0], labels[:, -1])]  # over the seam, and over the poles
    pairs += [(row, np.roll(row, len(row) // 2)) for row in (labels[0], labels[-1])]
    a, b = np.concatenate(pairs, axis=1)
    both = (a > 0) & (b > 0)
    graph = coo_array((np.ones(both.sum()), (a[both], b[both])), (number, number))
    return connected_components(graph, directed=False)[1][labels]
