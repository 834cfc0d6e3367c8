"""Initial lenses of raw pairs, by the calibration that their camera's maker wrote into its
files."""

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.factory_lenses import (
    ROTATION_SIGMA_RAD,
    FactoryCalibration,
    FactoryLenses,
    parse_factory_lenses,
)
from gsba.camera.fisheye import Pair
from gsba.containers.insta360 import read_trailer
from gsba.disk import write_json
from gsba.frames.lens_overlap import rim_likeness
from gsba.frames.raw_pairs import decode_pair
from gsba.log import GsbaError
from gsba.types import rows_across

_log = logging.getLogger(__name__)

FACTORY_FILE = "factory_lenses.json"  # beside the frames of a video
INSTA360_PICTURE = ".insp"  # suffix of JPEG images with both lenses side by side


def factory_calibration(
    files: Iterable[Path], two_tracks: bool = False
) -> FactoryCalibration | None:
    """The maker's calibration in the first of some files that holds a readable one.

    Args:
        files: videos or pictures of one camera, as it wrote them.
        two_tracks: True if they hold the lenses in two tracks, in an order that the file states.
    """
    for path in files:
        try:
            trailer = read_trailer(path, telemetry=False)
        except GsbaError as error:
            _log.info("no calibration by the maker: %s", error)
            continue
        if trailer is None:
            continue
        for text in trailer.lens_strings:
            window = trailer.window
            found = FactoryCalibration(
                text,
                camera=trailer.model,
                sensor=None if window is None else window.source,
                window=None if window is None else window.size,
                shift=(0, 0) if window is None else window.shift,
                back_first=two_tracks and trailer.back_track_first,
            )
            try:
                parse_factory_lenses(found)
            except GsbaError as error:
                _log.info("%s: not used: %s", path, error)
                continue
            return found
    return None


def write_factory_calibration(folder: Path, calibration: FactoryCalibration) -> None:
    """Write a maker's calibration beside frames, for `find_factory_lenses`."""
    write_json(folder / FACTORY_FILE, asdict(calibration))


def find_factory_lenses(folder: Path, images: Sequence[Path]) -> FactoryLenses | None:
    """The maker's calibration of frames: beside those of a video, or in pictures as the camera
    wrote them; None = there is none. GsbaError if the file beside the frames is damaged."""
    found = _read_factory_calibration(folder)
    if found is None and images and images[0].suffix.lower() == INSTA360_PICTURE:
        found = factory_calibration(images[:1])
    return None if found is None else parse_factory_lenses(found)


def starting_lenses(
    folder: Path, pairs: Sequence[tuple[Path, ...]], size: tuple[int, int], factory: FactoryLenses
) -> Pair:
    """Initial lenses of raw pairs by the maker's calibration, which leaves two questions to the
    images.

    Pictures may show the stated window of the sensor or all of it; and if somebody turned
    pictures, the back ones may be turned by quarters against the front ones. The usual reading is
    kept unless another one makes both lenses' rims clearly more alike.

    Args:
        pairs: pictures of the front and back lens of each frame, or twice the one that holds both.
        size: width and height of one lens's picture.
    """
    rows = rows_across(len(pairs), 8)
    looks = [decode_pair(pairs[f], size, gray=True) for f in rows]
    readings = [
        _with_back_turned(pair, quarters) for pair in factory.pairs(size) for quarters in range(4)
    ]
    scores = [rim_likeness(looks, pair) for pair in readings]
    best = int(np.argmax(scores))
    # gain in rim correlation from which another reading is preferred to the usual one
    if scores[best] <= scores[0] + 0.1:
        best = 0
    whole, quarters = divmod(best, 4)
    parts = [f"the back lens turned by {90 * quarters} degrees"] if quarters else []
    parts += ["the whole sensor in the picture"] if whole else []
    _log.warning(
        "%s: lenses start from the maker's calibration (generation %d; standard "
        "deviations: directions %.1f degrees, rotation between lenses %.1f%s), %s; for a better "
        "start pass --calibration FILE",
        folder,
        factory.generation,
        np.rad2deg(factory.direction_sigma),
        np.rad2deg(ROTATION_SIGMA_RAD),
        (f"; as images show, {' and '.join(parts)}" if parts else "")
        if factory.angles_known
        else "; its angles have no known form",
        "which both lenses' rims confirm" if scores[best] > 0.3 else "unconfirmed by images",
    )
    return readings[best]


def _read_factory_calibration(folder: Path) -> FactoryCalibration | None:
    """The maker's calibration beside frames; None = there is none."""
    path = folder / FACTORY_FILE
    try:
        with path.open("rb") as file:
            tree = json.loads(file.read(1 << 16))  # largest size of FACTORY_FILE
        texts = {key: tree[key] for key in ("text", "camera")}
        sizes = {key: tree[key] and _two_whole(tree[key]) for key in ("sensor", "window")}
        if not all(isinstance(text, str) for text in texts.values()):
            raise ValueError
        if not all(size is None or min(size) > 0 for size in sizes.values()):
            raise ValueError
        rest = {"shift": _two_whole(tree["shift"]), "back_first": bool(tree["back_first"])}
        return FactoryCalibration(**texts, **sizes, **rest)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise GsbaError(f"{path}: is damaged: remove it, or extract the frames again") from None


def _two_whole(values: Any) -> tuple[int, int]:
    """Two integers, or ValueError or TypeError."""
    first, second = values
    if not all(isinstance(value, int) and abs(value) < 1 << 20 for value in (first, second)):
        raise ValueError
    return first, second


def _with_back_turned(pair: Pair, quarters: int) -> Pair:
    """The pair with its back lens rotated by quarter turns about its axis."""
    if not quarters:
        return pair
    front, back = pair
    turn = Rotation.from_rotvec(back.rotation) * Rotation.from_euler("z", 90 * quarters, True)
    a, b, c = turn.as_rotvec().tolist()
    return front, replace(back, rotation=(a, b, c))
