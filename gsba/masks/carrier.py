"""What carries the camera, found from the frames: it stays where it is while the world moves.

Bag, stick, tripod, car roof or a painted nadir are fixed to the rig, so each of their pixels keeps
its colour over the run. That gives sure pixels, connected to the nadir without crossing an edge
(beyond which plain floor would stay as it is, too); a graph cut on the median
picture, in which the world has smeared away, finds the rest up to the outline (Rother, Kolmogorov,
Blake, GrabCut, SIGGRAPH 2004). With direction lock on, pictures do not turn with the camera and the
carrier turns below them: how far is found for each frame (`gsba.masks.carrier_turns`), and taken
back first.
"""

import logging
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.sphere import around_seam
from gsba.disk import write_image
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError, track
from gsba.masks.carrier_turns import band_of, find_turns
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

_WIDTH = 1024  # pixels across the pictures that are compared
_MAX_FRAMES = 48
_MIN_FRAMES = 6  # fewer do not tell what is fixed
_LEAST_TURN = np.deg2rad(2.0)  # less is the noise of finding turns
_LEAST_GAIN = 1.05  # of how well pixels stay: what turning must bring to be believed
_LEAST_FOUND = 0.95  # of the carrier found without it
_WRAP = 64  # pixels over the seam
_wrapped = partial(around_seam, columns=_WRAP)
_SURE = 0.25  # of the world's typical change: below it, a pixel is fixed
_SURE_LEVELS = (2.0, 5.0)  # bounds on that, grey levels
_STANDING_LEVELS = 3.0  # typical change of a world that does not move
_EDGE_LEVELS = 3.0  # per pixel, of the median picture along an outline
_MIN_OUTLINE = 0.7  # part of the outline on such edges: carriers have 0.9, plain floor up to 0.5
_GROWN = 3  # pixels: a cut through the carrier's blurred rim is no use


@dataclass(frozen=True, slots=True)
class Carrier:
    """Pixels that are not of the world."""

    mask: np.ndarray  # (H, 2H) bool, True = use; at the size of the frames, for turns of 0
    turns: np.ndarray  # (F,) float64, radians to the right, of the carrier in each frame
    median: np.ndarray  # (h, 2h, 3) uint8 RGB, the median picture
    share: float  # part of the picture that is the carrier; 0 = none found
    reason: str  # why there is none, or ""


def find_carrier(frames: FrameSet) -> Carrier:
    """The carrier in panoramas of a moving camera.

    Args:
        frames: panoramas; what their masks exclude in every frame is left out of account.

    Raises:
        GsbaError: cube faces, too few frames, or frames that hardly differ.
    """
    if not frames.panoramic:
        raise GsbaError("the carrier is looked for in panoramas; these frames are cube faces")
    if len(frames) < _MIN_FRAMES:
        raise GsbaError(f"{len(frames)} frames do not tell what is fixed to the camera: give more")
    chosen = np.unique(np.linspace(0, len(frames) - 1, _MAX_FRAMES).astype(int))
    pictures, bands = [], []
    for f in track(range(len(frames)), "looking for the carrier"):
        picture = load_erp(frames, f, width=_WIDTH)
        bands.append(band_of(picture))
        if f in chosen:
            pictures.append(picture)
    pictures, still = np.stack(pictures), np.zeros(len(frames))
    median, found, reason = _look(pictures)
    turns, gain = find_turns(np.stack(bands))
    logger.debug("gain of turning %.2f, by %.1f deg", gain, np.rad2deg(np.ptp(turns)))
    if np.ptp(turns) > _LEAST_TURN and gain > _LEAST_GAIN:
        back = -turns[chosen] / (2 * np.pi) * pictures.shape[2]
        turned = [np.roll(p, round(by), axis=1) for p, by in zip(pictures, back, strict=True)]
        other = _look(np.stack(turned))
        if other[1].sum() > _LEAST_FOUND * found.sum():
            (median, found, reason), still = other, turns
    turns = still
    grown = cv2.dilate(_wrapped(found.astype(np.uint8)), np.ones((_GROWN, _GROWN), np.uint8))
    grown = grown[:, _WRAP:-_WRAP] if found.any() else found.astype(np.uint8)
    size = (frames.width, frames.height)
    full = cv2.resize(grown.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) < 0.5
    share = float(np.mean(~full))
    turning = ", turning below it" if turns.any() else ""
    logger.info("carrier: %s", reason or f"{100 * share:.1f}% of the picture{turning}")
    return Carrier(full, turns, median, share, reason)


def _look(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray, str]:
    """Median picture (h, w, 3) uint8, the carrier in it (h, w) bool, and why there is none."""
    median, change = _median_and_change(pictures)
    height = len(median)
    world = float(np.median(change[height // 4 : height * 5 // 8]))
    if world < _STANDING_LEVELS:
        raise GsbaError(
            f"the frames hardly differ (by {world:.1f} grey levels): the camera must move for its "
            "carrier to stand out"
        )
    fixed = change < np.clip(_SURE * world, *_SURE_LEVELS)
    sure = _at_nadir(fixed & (_slope(median) < _EDGE_LEVELS))
    found = _cut(median, sure) if sure.any() else sure
    reason = "" if found.any() else "nothing at the nadir stays fixed"
    outline = _outline_sharpness(median, found)
    logger.debug("outline %.2f", outline)
    if found.any() and outline < _MIN_OUTLINE:
        reason = f"what stays fixed at the nadir has no outline ({100 * outline:.0f}% of it sharp)"
        found = np.zeros_like(found)
    return median, found, reason


def carrier_mask(carrier: Carrier, frames: FrameSet, frame: int) -> np.ndarray:
    """Where a frame shows the world, (H, 2H) bool, True = use."""
    return np.roll(carrier.mask, round(carrier.turns[frame] / (2 * np.pi) * frames.width), axis=1)


def write_carrier(carrier: Carrier, frames: FrameSet, out: Path, merge: bool = True) -> list[Path]:
    """Write what was found, to look at and to use.

    `carrier.png` is the mask (white = use), `carrier_check.jpg` the median picture with the
    outline. Where the frames have masks of their own, or the carrier turns, `merged/NAME.png` has
    all there is for each frame, unless `merge` is False.

    Returns:
        the files.
    """
    written = [out / "carrier.png", out / "carrier_check.jpg"]
    write_image(written[0], carrier.mask.astype(np.uint8) * 255)
    height, width = carrier.median.shape[:2]
    small = cv2.resize(carrier.mask.astype(np.uint8), (width, height), interpolation=0)
    shown = carrier.median.copy()
    shown[small == 0] = (shown[small == 0] * 0.5 + np.array([128, 0, 60])).astype(np.uint8)
    outlines, _ = cv2.findContours(1 - small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, outlines, -1, (255, 80, 160), 1)
    write_image(written[1], shown, jpeg_quality=88)
    for f, name in enumerate(frames.names):
        own = load_mask(frames, f)
        if merge and (own is not None or carrier.turns.any()):
            found = carrier_mask(carrier, frames, f)
            written.append(out / "merged" / f"{name}.png")
            union = found if own is None else own & found
            write_image(written[-1], union.astype(np.uint8) * 255)
    return written


def _median_and_change(pictures: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median picture (h, w, 3) uint8, and each pixel's median deviation from it (h, w) in levels.

    Exposure is evened out first, by what changes least in the lower half.
    """
    median, change = _statistics(pictures, np.ones(len(pictures)))
    half = len(median) // 2
    relative = change[half:] / (median[half:].mean(axis=-1) + 10.0)
    steady = relative <= np.quantile(relative, 0.1)
    levels = median[half:][steady].astype(np.float32) + 1
    gains = np.array([np.median((p[half:][steady] + 1.0) / levels) for p in pictures])
    return _statistics(pictures, np.clip(gains, 0.5, 2.0))


def _statistics(pictures: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median picture and deviation of pictures over their gains, a strip of rows at a time."""
    medians, changes = [], []
    for rows in np.array_split(np.arange(pictures.shape[1]), 16):
        strip = pictures[:, rows].astype(np.float32) / gains[:, None, None, None].astype(np.float32)
        median = np.median(strip, axis=0)
        changes.append(np.median(np.abs(strip - median).mean(axis=-1), axis=0))
        medians.append(median)
    return np.clip(np.concatenate(medians), 0, 255).astype(np.uint8), np.concatenate(changes)


def _at_nadir(fixed: np.ndarray) -> np.ndarray:
    """The parts (h, w) bool that reach the lowest rows, over the seam too."""
    labels = cv2.connectedComponents(_wrapped(fixed.astype(np.uint8)), connectivity=4)[1]
    lowest = labels[-max(2, len(labels) // 100) :]
    return np.isin(labels, np.setdiff1d(np.unique(lowest), [0]))[:, _WRAP:-_WRAP]


def _cut(median: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """All of the carrier (h, w) bool, from sure pixels of it and the look of the median picture."""
    labels = np.full(sure.shape, cv2.GC_PR_BGD, np.uint8)
    labels[: len(labels) // 2] = cv2.GC_BGD
    labels[sure] = cv2.GC_FGD
    labels[: len(labels) // 2][sure[: len(labels) // 2]] = cv2.GC_PR_FGD
    cv2.setRNGSeed(0)
    wrapped = _wrapped(labels)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    nowhere = (0, 0, 0, 0)  # no rectangle: the labels say it all
    cv2.grabCut(_wrapped(median), wrapped, nowhere, *models, 5, cv2.GC_INIT_WITH_MASK)
    found = (wrapped == cv2.GC_FGD) | (wrapped == cv2.GC_PR_FGD)
    return _at_nadir(found[:, _WRAP:-_WRAP])


def _outline_sharpness(median: np.ndarray, found: np.ndarray) -> float:
    """Part of the outline, above the lowest rows, that lies on an edge of the median picture."""
    inside = _wrapped(found.astype(np.uint8))
    rim = cv2.dilate(inside, np.ones((3, 3), np.uint8)) != cv2.erode(inside, np.ones((3, 3)))
    rim = rim[: int(0.98 * len(rim)), _WRAP:-_WRAP]
    if not rim.any():
        return 0.0
    return float(np.mean(_slope(median)[: len(rim)][rim] >= _EDGE_LEVELS))


def _slope(median: np.ndarray) -> np.ndarray:
    """Gradient (h, w) of the median picture, grey levels per pixel."""
    grey = _wrapped(cv2.cvtColor(median, cv2.COLOR_RGB2GRAY)).astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1)) / 8
    return slope[:, _WRAP:-_WRAP]
