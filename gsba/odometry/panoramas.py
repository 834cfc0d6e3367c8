"""Small grey panoramas of a video or of a folder of frames, one after another."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from gsba.camera.equiangular import squares
from gsba.camera.factory_lenses import parse_factory_lenses
from gsba.camera.fisheye import Rig
from gsba.disk import write_image
from gsba.frames.dual_fisheye import clear_of_seam, join_pictures, width_of
from gsba.frames.factory_start import starting_lenses
from gsba.frames.image_circles import ImageCircle
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.frames.raw_pairs import lenses_of
from gsba.frames.track_pairs import panorama_of
from gsba.log import GsbaError
from gsba.masks.carrier import PICTURE_WIDTH, find_fixed_carrier
from gsba.store.shards import content_digest
from gsba.store.store import fingerprint
from gsba.types import FrameSet, rows_across
from gsba.video.recording import (
    EXACT_S,
    VideoRecording,
    factory_calibration_of,
    read_recording,
    shots,
)

logger = logging.getLogger(__name__)

WIDTH = 800  # pixels across: fast, and a run measures its keypoints in the full pictures
_CARRIER_LOOKS = 20  # frames in which the carrier is detected
_LEAST = 3  # least number of frames of a sequence


@dataclass(frozen=True, slots=True)
class SmallPanoramas:
    """A sequence of panoramas that are read on demand."""

    source: Path  # video or folder
    timestamps: np.ndarray  # (F,) float64, seconds, strictly increasing
    width: int  # pixels across
    read: Callable[[Sequence[int], bool], Iterator[tuple[int, np.ndarray]]]  # rows, in colour ->
    # (row, (h, 2h[, 3]) uint8, RGB); rows that are damaged are left out
    contents: str  # digest of the files and of the lenses by which they are read
    usable: np.ndarray | None = None  # (h, 2h) bool, pixels that show the scene in every frame

    def __len__(self) -> int:
        return len(self.timestamps)


def of_frames(frames: FrameSet, source: Path, width: int = WIDTH) -> SmallPanoramas:
    """Panoramas of a folder of panoramas or raw pairs, `width` pixels across, less if the frames
    are smaller; pixels masked in all frames are masked. GsbaError: cube faces."""
    if not frames.format.panoramic:
        raise GsbaError(f"{source}: holds cube faces; odometry follows panoramas or raw fisheyes")
    width = min(width, frames.format.width)
    size = (width, width // 2)

    def read(rows: Sequence[int], colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        for row in rows:
            picture = load_erp(frames, row, not colour, width)
            yield row, cv2.resize(picture, size, interpolation=cv2.INTER_AREA)

    files = fingerprint(path for group in frames.paths for path in group)
    contents = content_digest(files, frames.formats)
    found = SmallPanoramas(source, frames.timestamps, width, read, contents)
    usable = np.ones(size[::-1], bool)
    if frames.format.fisheyes is not None:
        usable &= clear_of_seam(width // 2, frames.format.fisheyes)
    masked = any(path is not None for path in frames.mask_paths)
    looks = rows_across(len(frames), _CARRIER_LOOKS)
    for row in looks.tolist() if masked else ():
        mask = load_mask(frames, row)
        if mask is not None:
            share = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            usable &= share > 0.9
    return found if usable.all() else replace(found, usable=usable)


def of_video(
    video: Path,
    width: int = WIDTH,
    calibration: Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    circles: Sequence[ImageCircle] = (),
) -> SmallPanoramas:
    """Panoramas of a video: stitched, or raw and joined by its lenses' calibration file, None = by
    `circles` as of `frames.scan`, the maker's file, or circles found. They are `width` pixels
    across, less if the video is smaller, from `from_s` to `to_s` seconds since its first frame;
    None = all.

    Raises:
        GsbaError: no such video, fewer than three frames, or a raw one without image circles.
    """
    if not video.is_file():
        raise GsbaError(f"{video}: no such file")
    recording = read_recording(video)
    low, high = from_s or 0.0, np.inf if to_s is None else to_s
    within = (recording.times >= low - EXACT_S) & (recording.times <= high + EXACT_S)
    rows = np.flatnonzero(recording.shown & within)
    if len(rows) < _LEAST:
        raise GsbaError(
            f"{video}: {len(rows)} frames between {low:g} and {high:g} s; at least {_LEAST} are "
            "needed"
        )
    widest = 4 * recording.width // 3 if recording.cube else recording.width
    width = min(width, widest * (2 if recording.lenses else 1)) // 2 * 2
    size = (width, width // 2)
    pair = _lenses(recording, rows, calibration, circles) if recording.lenses else None
    share = 1.0 if pair is None else width / width_of(pair)
    usable = None if pair is None else clear_of_seam(width // 2, pair)

    def read(chosen: Sequence[int], colour: bool) -> Iterator[tuple[int, np.ndarray]]:
        number = {int(rows[row]): int(row) for row in chosen}
        for index, pictures in shots(recording, [int(rows[row]) for row in chosen]):
            planes = [
                np.ascontiguousarray(picture.bgr()[..., ::-1]) if colour else picture.luma()
                for picture in pictures
            ]
            if recording.cube:
                whole = panorama_of(squares((planes[0], planes[1])), width)
            else:
                whole = planes[0] if pair is None else join_pictures(planes, pair, width, share)
            yield number[index], cv2.resize(whole, size, interpolation=cv2.INTER_AREA)

    contents = content_digest(fingerprint(track.path for track in recording.tracks), pair)
    return SmallPanoramas(video, recording.times[rows], width, read, contents, usable)


def without_carrier(panoramas: SmallPanoramas) -> SmallPanoramas:
    """The panoramas with the carrier masked, if it keeps its place in the pictures; else nothing is
    masked, and a line in the log says so."""
    rows = rows_across(len(panoramas), _CARRIER_LOOKS).tolist()
    size = (PICTURE_WIDTH, PICTURE_WIDTH // 2)
    pictures = [cv2.resize(picture, size) for _, picture in panoramas.read(rows, True)]
    try:
        found = find_fixed_carrier(np.stack(pictures) if pictures else np.zeros((0, 1, 2, 3)))
    except GsbaError as error:
        logger.info("nothing is masked: %s", error)
        return panoramas
    logger.info("carrier: %.1f%% of the picture", 100 * (1 - found.mean()))
    return _narrowed(panoramas, found)


def masked(panoramas: SmallPanoramas, mask: Path) -> SmallPanoramas:
    """The panoramas, masked by a 2:1 picture for all frames, white = use. GsbaError: the mask
    cannot be read, or is not 2:1."""
    levels = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
    if levels is None:
        raise GsbaError(f"{mask}: cannot be read as a picture; give a 2:1 mask, white = use")
    if levels.shape[1] != 2 * levels.shape[0]:
        raise GsbaError(f"{mask}: is {levels.shape[1]}x{levels.shape[0]}; a mask is 2:1")
    return _narrowed(panoramas, levels > 127)


def _narrowed(panoramas: SmallPanoramas, usable: np.ndarray) -> SmallPanoramas:
    """The panoramas, masked by another mask (h, 2h) bool of any size besides."""
    size = (panoramas.width, panoramas.width // 2)
    fitted = cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.9
    before = panoramas.usable
    return replace(panoramas, usable=fitted if before is None else fitted & before)


def _lenses(
    recording: VideoRecording,
    rows: np.ndarray,
    calibration: Path | None,
    circles: Sequence[ImageCircle],
) -> Rig:
    """Initial lenses of a raw recording, from a few of its frames."""
    looks = rows_across(len(rows), 8)
    size = (recording.width, recording.width)
    with TemporaryDirectory(prefix="gsba-") as name:
        pairs = []
        for index, pictures in shots(recording, rows[looks].tolist()):
            pair = tuple(Path(name) / f"lens{n}" / f"{index:06d}.png" for n in range(2))
            for path, picture in zip(pair, pictures, strict=True):
                path.parent.mkdir(exist_ok=True)
                write_image(path, picture.luma())
            pairs.append(pair)
            size = pictures[0].luma().shape[::-1]
        nothing_given = calibration is None and not circles
        factory = factory_calibration_of(recording) if nothing_given else None
        try:
            if factory is not None:
                return starting_lenses(Path(name), pairs, size, parse_factory_lenses(factory))
            return lenses_of(Path(name), pairs, size, calibration, circles)[0]
        except GsbaError as error:
            where = str(recording.tracks[0].path)
            raise GsbaError(str(error).replace(name, where)) from None
