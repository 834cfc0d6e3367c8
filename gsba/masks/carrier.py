"""Detection of the camera's carrier: it keeps its direction in the rig while the world moves.

Head, shoulders, arm, stick, helmet, bag or vehicle move with the camera, so that their structure
keeps its place in the picture (`gsba.masks.fixed_structure`), up to an outline
(`gsba.masks.carrier_outline`). With direction lock on, pictures do not turn with the camera and the
carrier turns against them: this rotation is estimated for each frame (`gsba.masks.fixed_structure`)
and undone first.
"""

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from gsba.disk import write_image
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError, track
from gsba.masks.borders import black_areas, widened
from gsba.masks.carrier_outline import certain_places, outline_carrier
from gsba.masks.fixed_structure import (
    FixedStructure,
    band_of,
    find_turns,
    measure_fixed_structure,
    median_picture,
)
from gsba.memory import usable_cpus
from gsba.types import FrameSet, PictureFormat, rows_across

logger = logging.getLogger(__name__)

PICTURE_WIDTH = 512  # pixels across the pictures in which the outline is found
_MIN_FRAMES = 6  # fewer agree by chance
_MIN_FIXED_CORRELATION, _MAX_MOVING_CORRELATION = 0.75, 0.5  # least correlation of fixed structure;
# largest of moving structure
_MAX_STEADINESS_ABOVE = 0.25  # correlation above a carrier that turns: .06 to .08 on walks, .4 and
# more where the camera sways on the spot, and the room is what turns
VEHICLE_SHARE = 1 / 3  # share of the picture from which the carrier is a vehicle: people and sticks
# fill less
_STRUCTURE_WIDTH_PX, _TURNED_STRUCTURE_WIDTH_PX = 256, 128  # width in pixels of compared pictures:
# the camera's tilt, which remains when turns are undone, moves the carrier by a pixel of the latter


@dataclass(frozen=True, slots=True)
class Carrier:
    """The pixels that show the carrier instead of the world."""

    mask: np.ndarray  # (h, 2h) bool, True = use; smaller than the frames, for turns of 0
    turns: np.ndarray  # (F,) float64, radians to the right, rotation of the carrier in each frame
    median: np.ndarray  # (h, 2h, 3) uint8 RGB, the median picture
    share: float  # part of the picture that the carrier fills; 0 = none found
    reason: str  # why no carrier was found, or ""


def no_carrier(frames: FrameSet, reason: str) -> Carrier:
    """A carrier without pixels, with the reason."""
    size = PICTURE_WIDTH // 2, PICTURE_WIDTH
    grey = np.full((*size, 3), 128, np.uint8)
    return Carrier(np.ones(size, bool), np.zeros(len(frames)), grey, 0.0, reason)


def find_carrier(frames: FrameSet) -> Carrier:
    """Detect the carrier in panoramas or raw pairs of a moving camera. GsbaError: cube faces, too
    few frames, no texture, or too little motion."""
    if not frames.format.panoramic:
        raise GsbaError("the carrier is detected in panoramas; these frames are cube faces")
    _require_enough(len(frames))
    chosen = rows_across(len(frames), 20)
    with ThreadPoolExecutor(usable_cpus()) as pool:
        loaded = pool.map(partial(_load, frames), chosen.tolist())
        pictures = np.stack(list(track(loaded, "looking for the carrier", len(chosen))))
    structure, turns = _measure(pictures, _STRUCTURE_WIDTH_PX), np.zeros(len(frames))
    # fewer agree by chance once turns are free
    if not certain_places(structure).any() and len(pictures) >= 12:
        below = _measure_turned(pictures)
        if below is not None:
            bands = [band_of(_load(frames, f)) for f in track(range(len(frames)), "its turns")]
            turns, (pictures, structure) = find_turns(np.stack(bands)), below
    median, found = _outlined(pictures, structure)
    share = float(found.mean())
    reason = "" if found.any() else "nothing turns with the camera"
    turns = turns if found.any() else np.zeros(len(frames))
    turning = ", turning below it" if turns.any() else ""
    logger.info("carrier: %s", reason or f"{100 * share:.1f}% of the picture{turning}")
    if share > VEHICLE_SHARE:
        logger.warning(
            "%.0f%% of the picture turn with the camera, as a vehicle does, and are masked: poses "
            "come from the remaining pixels; check the mask in carrier_check.jpg",
            100 * share,
        )
    return Carrier(~found, turns, median, share, reason)


def find_fixed_carrier(pictures: np.ndarray) -> np.ndarray:
    """Mask (h, 2h) bool of the world in pictures (N, h, 2h, 3) uint8 RGB, `PICTURE_WIDTH` across,
    of a moving camera: False at a carrier that keeps its direction. GsbaError: too few pictures, no
    texture, or too little motion."""
    _require_enough(len(pictures))
    return ~_outlined(pictures, _measure(pictures, _STRUCTURE_WIDTH_PX))[1]


def _require_enough(num: int) -> None:
    if num < _MIN_FRAMES:
        raise GsbaError(f"{num} frames are too few to detect the carrier: give {_MIN_FRAMES}")


def _outlined(pictures: np.ndarray, structure: FixedStructure) -> tuple[np.ndarray, np.ndarray]:
    """The median (h, 2h, 3) uint8 of pictures, and the carrier in it (h, 2h) bool."""
    heights = (np.arange(len(structure.strong)) + 0.5) / len(structure.strong)
    weights = structure.textured * np.sin(np.pi * heights)[:, None]  # solid angles
    if weights.mean() < 0.02:  # of all directions
        raise GsbaError("the frames show too little texture to detect the carrier")
    staying, moving = (
        float((weights * places).sum() / weights.sum())
        for places in (
            structure.strong > _MIN_FIXED_CORRELATION,
            structure.strong < _MAX_MOVING_CORRELATION,
        )
    )
    logger.debug("textured: %.0f%% stay, %.0f%% move", 100 * staying, 100 * moving)
    if staying > 0.9:
        raise GsbaError(
            f"the frames hardly differ ({100 * staying:.0f}% of textured directions stay fixed): "
            "the camera must move to detect its carrier"
        )
    if moving < 1 / 3:
        raise GsbaError(
            f"{100 * staying:.0f}% of textured directions stay fixed, only "
            f"{100 * moving:.0f}% move: most of the picture is a vehicle, or far away, or the "
            "camera hardly moves; give a mask of the carrier (--masks FILE)"
        )
    median = median_picture(pictures).astype(np.uint8)
    return median, outline_carrier(pictures, median, structure)


def carrier_mask(carrier: Carrier, kind: PictureFormat, frame: int) -> np.ndarray:
    """Mask of the world in the frame-th of the frames that the carrier was detected in, whose
    pictures have a format: (H, 2H) bool, True = use."""
    size = kind.width, kind.height
    full = cv2.resize(carrier.mask.astype(np.float32), size) > 0.5
    return np.roll(full, round(carrier.turns[frame] / (2 * np.pi) * kind.width), axis=1)


def marked(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A picture (h, 2h, 3) uint8 RGB in which masked places (h, 2h) bool are red, with an
    outline."""
    shown = picture.copy()
    shown[places] = (shown[places] * 0.5 + np.array([128, 0, 60])).astype(np.uint8)
    inside = places.astype(np.uint8)
    outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, outlines, -1, (255, 80, 160), 1)
    return shown


def write_carrier(carrier: Carrier, frames: FrameSet, out: Path) -> list[Path]:
    """Write the carrier's mask, and a picture to check it; returns the files.

    `carrier.png` is the mask (white = use), `carrier_check.jpg` the median picture with the
    outline. If the frames have masks of their own, or the carrier turns, `merged/FRAME.png`
    combines the masks of each frame.
    """
    written = [out / "carrier.png", out / "carrier_check.jpg"]
    write_image(written[0], carrier_mask(carrier, frames.format, 0).astype(np.uint8) * 255)
    write_image(written[1], marked(carrier.median, ~carrier.mask), jpeg_quality=88)
    for f, frame in enumerate(frames.names):
        own = load_mask(frames, f)
        if own is not None or carrier.turns.any():
            found = carrier_mask(carrier, frames.format, f)
            written.append(out / "merged" / f"{frame}.png")
            union = found if own is None else own & found
            write_image(written[-1], union.astype(np.uint8) * 255)
    return written


def _load(frames: FrameSet, f: int) -> np.ndarray:
    """Frame f, (PICTURE_WIDTH / 2, PICTURE_WIDTH, 3) uint8 RGB."""
    picture = load_erp(frames, f, width=PICTURE_WIDTH)
    if picture.shape[1] != PICTURE_WIDTH:
        picture = cv2.resize(picture, (PICTURE_WIDTH, PICTURE_WIDTH // 2))
    return picture


def _measure(pictures: np.ndarray, width: int) -> FixedStructure:
    """Fixed structure of pictures; rims of areas without pixels, which ride along, have none."""
    size = width, width // 2
    small = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in pictures]
    found = measure_fixed_structure(np.stack(small))
    black = black_areas(pictures.max(axis=0).max(axis=2))
    if not black.any():
        return found
    small = cv2.resize(black.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
    scene = ~widened(small, 6)  # pixels
    return FixedStructure(found.strong * scene, found.weak * scene, found.textured & scene)


def _measure_turned(pictures: np.ndarray) -> tuple[np.ndarray, FixedStructure] | None:
    """Pictures rotated so that the carrier keeps its direction, and their structure; None = no
    turns, or those of the camera itself."""
    turns = find_turns(np.stack([band_of(picture) for picture in pictures]))
    if np.ptp(turns) < np.deg2rad(2.0):  # smaller ones are estimation noise
        return None
    back = -turns / (2 * np.pi) * pictures.shape[2]
    rolls = zip(pictures, back, strict=True)
    turned = np.stack([np.roll(picture, round(by), axis=1) for picture, by in rolls])
    coarse = _measure(turned, _TURNED_STRUCTURE_WIDTH_PX)
    if not certain_places(coarse).any():
        return None
    above = _steadiness_above(coarse)
    if above > _MAX_STEADINESS_ABOVE:
        as_taken = _measure(pictures, _TURNED_STRUCTURE_WIDTH_PX)
        if above > _steadiness_above(as_taken) / 2:  # a far world moves by the turns alone
            return None
    fine = _measure(turned, _STRUCTURE_WIDTH_PX)
    return turned, fine if certain_places(fine).any() else coarse


def _steadiness_above(structure: FixedStructure) -> float:
    """Mean correlation of the textured directions above the carrier; 0 = there are none."""
    rows = int(0.55 * len(structure.strong))  # from the zenith, where the world is seen
    textured = structure.textured[:rows]
    return float(structure.strong[:rows][textured].mean()) if textured.any() else 0.0
