"""The outline of what carries the camera, from where it surely is and the look of the picture.

Structure that stays (`gsba.masks.fixed_structure`) marks the carrier but for its plain parts, and
spills over its outline by the window of the comparison. Its core and what surely moves are given to
a graph cut on the median picture, in which the world has smeared away (Rother, Kolmogorov, Blake,
GrabCut, SIGGRAPH 2004). Plain parts that the carrier encloses belong to it.
"""

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsba.camera.sphere import around_sphere
from gsba.masks.fixed_structure import FixedStructure

_PAD = 32  # pixels around the sphere
_CERTAIN, _CERTAIN_WEAK = 0.75, 0.6  # least correlations that only a carrier has, see docs/masks.md
_LIKELY_WEAK = 0.2  # least weak correlation of what is joined to such a place
_SPILL = 6  # pixels by which fixed structure reaches over the outline
_REACH = 28  # pixels from fixed structure within which the outline is looked for
_MOVING = 3.0  # times the carrier's own change: more is the world
_LEAST_CHANGE = 1.0  # grey levels, of a carrier without noise
_ROUNDS = 2  # of the graph cut and its colours
_GROWN = 1  # pixels: features on the carrier's blurred rim are no use


def certain_places(structure: FixedStructure) -> np.ndarray:
    """Where structure stays along both its directions (h, 2h) bool, at the size of `structure`."""
    return (structure.strong > _CERTAIN) & (structure.weak > _CERTAIN_WEAK)


def outline_carrier(
    pictures: np.ndarray, median: np.ndarray, structure: FixedStructure
) -> np.ndarray:
    """What carries the camera, (h, 2h) bool; all False where there is none.

    Args:
        pictures: (K, h, 2h, 3) uint8 panoramas in which it does not move.
        median: (h, 2h, 3) uint8, of these pictures.
        structure: of these pictures, smaller.
    """
    height, width = pictures.shape[1:3]
    nothing = np.zeros((height, width), bool)
    if not certain_places(structure).any():
        return nothing
    sure, strong, weak = (
        cv2.resize(x.astype(np.float32), (width, height))
        for x in (certain_places(structure), structure.strong, structure.weak)
    )
    likely = (strong > _CERTAIN) | ((strong > _LIKELY_WEAK) & (weak > _LIKELY_WEAK))
    likely = _parts_with(likely, sure > 0.5)
    core = _shrunk(likely, _SPILL)
    if not core.any():
        return nothing
    change = _change(pictures, median)
    own_change = max(float(np.median(change[core])), _LEAST_CHANGE)
    moves = (_around(cv2.GaussianBlur, change, (0, 0), 1.0) > _MOVING * own_change) & ~core
    found = _parts_with(_cut(median, core, likely, moves), core)
    plain = _enclosed(found)
    found |= plain & ~_parts_with(plain, moves, least=0.5)
    return _around(cv2.dilate, found, np.ones((3, 3), np.uint8), iterations=_GROWN) > 0


def _cut(median: np.ndarray, core: np.ndarray, likely: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The carrier (h, w) bool by colours and edges of the median picture (h, w, 3) uint8."""
    distance = _around(cv2.distanceTransform, ~likely, cv2.DIST_L2, 5)
    far = distance > _REACH
    inside = _enclosed(~far)
    labels = np.full(core.shape, cv2.GC_PR_BGD, np.uint8)
    labels[inside | _shrunk(likely, _SPILL // 2)] = cv2.GC_PR_FGD
    labels[(far & ~inside) | moves] = cv2.GC_BGD
    labels[core] = cv2.GC_FGD
    smooth = _around(cv2.GaussianBlur, median, (0, 0), 1.0, crop=False)
    padded = around_sphere(labels, _PAD)
    nowhere, models = (0, 0, 0, 0), (np.zeros((1, 65)), np.zeros((1, 65)))
    cv2.setRNGSeed(0)
    cv2.grabCut(smooth, padded, nowhere, *models, _ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.isin(padded[_PAD:-_PAD, _PAD:-_PAD], (cv2.GC_FGD, cv2.GC_PR_FGD))


def _change(pictures: np.ndarray, median: np.ndarray) -> np.ndarray:
    """Median deviation (h, w) float32 of each pixel from the median picture, grey levels."""
    rows = np.array_split(np.arange(len(median)), 8)  # little memory at a time
    parts = [np.abs(pictures[:, r].astype(np.int16) - median[r]).mean(axis=-1) for r in rows]
    return np.concatenate([np.median(part, axis=0) for part in parts]).astype(np.float32)


def _shrunk(places: np.ndarray, pixels: int) -> np.ndarray:
    return _around(cv2.erode, places, np.ones((3, 3), np.uint8), iterations=pixels) > 0


def _around(work, image: np.ndarray, *arguments, crop: bool = True, **options) -> np.ndarray:
    """What OpenCV makes of an image (h, 2h[, C]) that goes on beyond seam and poles."""
    image = image.astype(np.uint8) if image.dtype == bool else image
    done = work(around_sphere(image, _PAD), *arguments, **options)
    return done[_PAD:-_PAD, _PAD:-_PAD] if crop else done


def _parts_with(places: np.ndarray, marks: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Connected parts of places (h, w) bool of which more than this share is marked (h, w) bool."""
    labels = _label(places)
    shares = np.bincount(labels.ravel(), marks.ravel()) / np.maximum(np.bincount(labels.ravel()), 1)
    return places & (shares > least)[labels]


def _enclosed(found: np.ndarray) -> np.ndarray:
    """All but the largest connected part (h, w) bool of what is not found."""
    labels = _label(~found)
    sizes = np.bincount(labels[~found], minlength=1)
    return ~found & (labels != np.argmax(sizes))


def _label(places: np.ndarray) -> np.ndarray:
    """Number (h, 2h) of the part on the sphere that each of these places is connected to."""
    number, labels = cv2.connectedComponents(places.astype(np.uint8), connectivity=4)
    pairs = [(labels[:, 0], labels[:, -1])]  # over the seam, and over the poles
    pairs += [(row, np.roll(row, len(row) // 2)) for row in (labels[0], labels[-1])]
    a, b = np.concatenate(pairs, axis=1)
    both = (a > 0) & (b > 0)
    graph = coo_array((np.ones(both.sum()), (a[both], b[both])), (number, number))
    return connected_components(graph, directed=False)[1][labels]
