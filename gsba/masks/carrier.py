"""What carries the camera, found from the frames: it keeps its direction while the world moves.

Head, shoulders, arm, stick, helmet, bag or vehicle turn with the camera, so that their structure
stays where it is in the picture (`gsba.masks.fixed_structure`), up to an outline
(`gsba.masks.carrier_outline`). With direction lock on, pictures do not turn with the camera and the
carrier turns below them: how far is found for each frame (`gsba.masks.carrier_turns`), and taken
back first.
"""

import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.disk import write_image
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.log import GsbaError, track
from gsba.masks.carrier_outline import certain_places, outline_carrier
from gsba.masks.carrier_turns import band_of, find_turns
from gsba.masks.fixed_structure import FixedStructure, measure_fixed_structure
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

PICTURE_WIDTH = 512  # pixels across the pictures in which the outline is found
_MAX_FRAMES = 20
_MIN_FRAMES = 6  # fewer agree by chance
_STAYS, _MOVES = 0.75, 0.5  # correlation of structure that stays; of structure that moves, at most
_MIN_MOVING = 1 / 3  # of the textured directions: fewer do not tell a carrier from what is far away
_STANDING = 0.9  # of the textured directions that stay: the camera stands
VEHICLE_SHARE = 1 / 3  # of the picture: more than people or sticks fill
_MIN_TEXTURED = 0.02  # of all directions
_STRUCTURE, _STRUCTURE_TURNED = 256, 128  # pixels across the pictures that are compared: the
# camera's tilt, which turns leave, moves the carrier by a pixel of these
_LEAST_TURN = np.deg2rad(2.0)  # less is the noise of finding turns
_MIN_FRAMES_TURNED = 12  # fewer agree by chance once turns are free


@dataclass(frozen=True, slots=True)
class Carrier:
    """Pixels that are not of the world."""

    mask: np.ndarray  # (h, 2h) bool, True = use; smaller than the frames, for turns of 0
    turns: np.ndarray  # (F,) float64, radians to the right, of the carrier in each frame
    median: np.ndarray  # (h, 2h, 3) uint8 RGB, the median picture
    share: float  # part of the picture that is the carrier; 0 = none found
    reason: str  # why there is none, or ""


def no_carrier(frames: FrameSet, reason: str) -> Carrier:
    """A carrier that covers nothing, for this reason."""
    size = PICTURE_WIDTH // 2, PICTURE_WIDTH
    grey = np.full((*size, 3), 128, np.uint8)
    return Carrier(np.ones(size, bool), np.zeros(len(frames)), grey, 0.0, reason)


def find_carrier(frames: FrameSet) -> Carrier:
    """The carrier in panoramas of a moving camera.

    Args:
        frames: panoramas or raw pairs.

    Raises:
        GsbaError: cube faces, too few frames, no texture, or too little that moves.
    """
    if not frames.panoramic:
        raise GsbaError("the carrier is looked for in panoramas; these frames are cube faces")
    _require_enough(len(frames))
    chosen = np.unique(np.linspace(0, len(frames) - 1, _MAX_FRAMES).astype(int))
    pictures = np.stack([_load(frames, f) for f in track(chosen, "looking for the carrier")])
    structure, turns = _measure(pictures, _STRUCTURE), np.zeros(len(frames))
    if not certain_places(structure).any() and len(pictures) >= _MIN_FRAMES_TURNED:
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
            "rest on the rest; look at carrier_check.jpg",
            100 * share,
        )
    return Carrier(~found, turns, median, share, reason)


def find_fixed_carrier(pictures: np.ndarray) -> np.ndarray:
    """Where pictures show the world and not what carries the camera, if it keeps its direction.

    Args:
        pictures: (N, h, 2h, 3) uint8 RGB, `PICTURE_WIDTH` across, of a moving camera.

    Returns:
        (h, 2h) bool, True = use; all of it where nothing stays in place.

    Raises:
        GsbaError: too few pictures, no texture, or too little that moves.
    """
    _require_enough(len(pictures))
    return ~_outlined(pictures, _measure(pictures, _STRUCTURE))[1]


def _require_enough(num: int) -> None:
    if num < _MIN_FRAMES:
        raise GsbaError(f"{num} frames do not tell what is fixed to the camera: give {_MIN_FRAMES}")


def _outlined(pictures: np.ndarray, structure: FixedStructure) -> tuple[np.ndarray, np.ndarray]:
    """The median (h, 2h, 3) uint8 of pictures, and where it shows the carrier (h, 2h) bool.

    Raises:
        GsbaError: too little moves to tell.
    """
    _check_moving(structure)
    median = np.median(pictures, axis=0).astype(np.uint8)
    return median, outline_carrier(pictures, median, structure)


def carrier_mask(carrier: Carrier, frames: FrameSet, frame: int) -> np.ndarray:
    """Where a frame shows the world, (H, 2H) bool, True = use."""
    full = cv2.resize(carrier.mask.astype(np.float32), (frames.width, frames.height)) > 0.5
    return np.roll(full, round(carrier.turns[frame] / (2 * np.pi) * frames.width), axis=1)


def write_carrier(
    carrier: Carrier, frames: FrameSet, out: Path, merge: bool = True, name: str = "carrier"
) -> list[Path]:
    """Write what was found, to look at and to use.

    `NAME.png` is the mask (white = use), `NAME_check.jpg` the median picture with the outline.
    Where the frames have masks of their own, or the carrier turns, `merged/FRAME.png` has all there
    is for each frame, unless `merge` is False.

    Returns:
        the files.
    """
    written = [out / f"{name}.png", out / f"{name}_check.jpg"]
    write_image(written[0], carrier_mask(carrier, frames, 0).astype(np.uint8) * 255)
    shown = carrier.median.copy()
    shown[~carrier.mask] = (shown[~carrier.mask] * 0.5 + np.array([128, 0, 60])).astype(np.uint8)
    inside = (~carrier.mask).astype(np.uint8)
    outlines, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(shown, outlines, -1, (255, 80, 160), 1)
    write_image(written[1], shown, jpeg_quality=88)
    for f, frame in enumerate(frames.names):
        own = load_mask(frames, f)
        if merge and (own is not None or carrier.turns.any()):
            found = carrier_mask(carrier, frames, f)
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
    size = width, width // 2
    small = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in pictures]
    return measure_fixed_structure(np.stack(small))


def _measure_turned(pictures: np.ndarray) -> tuple[np.ndarray, FixedStructure] | None:
    """Pictures with the carrier turned to one direction, and their structure; None = it stays."""
    turns = find_turns(np.stack([band_of(picture) for picture in pictures]))
    if np.ptp(turns) < _LEAST_TURN:
        return None
    back = -turns / (2 * np.pi) * pictures.shape[2]
    rolls = zip(pictures, back, strict=True)
    turned = np.stack([np.roll(picture, round(by), axis=1) for picture, by in rolls])
    coarse = _measure(turned, _STRUCTURE_TURNED)
    if not certain_places(coarse).any():
        return None
    fine = _measure(turned, _STRUCTURE)
    return turned, fine if certain_places(fine).any() else coarse


def _check_moving(structure: FixedStructure) -> None:
    """Refuse frames in which too little moves for what stays to be the carrier.

    Raises:
        GsbaError: saying how much stays.
    """
    heights = (np.arange(len(structure.strong)) + 0.5) / len(structure.strong)
    weights = structure.textured * np.sin(np.pi * heights)[:, None]  # solid angles
    if weights.mean() < _MIN_TEXTURED:
        raise GsbaError("the frames show too little texture to tell what stays in place")
    staying, moving = (
        float((weights * places).sum() / weights.sum())
        for places in (structure.strong > _STAYS, structure.strong < _MOVES)
    )
    logger.debug("textured: %.0f%% stay, %.0f%% move", 100 * staying, 100 * moving)
    if staying > _STANDING:
        raise GsbaError(
            f"the frames hardly differ ({100 * staying:.0f}% of what has texture stays in its "
            "direction): the camera must move for its carrier to stand out"
        )
    if moving < _MIN_MOVING:
        raise GsbaError(
            f"{100 * staying:.0f}% of what has texture stays in its direction and only "
            f"{100 * moving:.0f}% moves: most of the picture is a vehicle, or far away, or the "
            "camera hardly moves; give a mask of what carries it (--masks FILE)"
        )
