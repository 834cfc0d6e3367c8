"""Extraction of chosen frames of a video as images with their exact times.

`FRAMES/NNNNNN.jpg` is frame NNNNNN of the video, counted from 0; `timestamps.csv` gives the seconds
since the first one. Of raw recordings, `FRAMES/front/NNNNNN.jpg` and `FRAMES/back/NNNNNN.jpg` are
the images of both lenses at one instant, and NNNNNN counts frames of the front one;
`factory_lenses.json` is the maker's calibration, if the video holds one. Of GoPro's `.360`,
`FRAMES/track0/NNNNNN.jpg` and `FRAMES/track5/NNNNNN.jpg` are the images of both tracks.
`extract.json` holds the key of the settings, so that the same call resumes and another one does not
mix its frames in.
"""

import csv
import json
import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, astuple, dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from gsba.config import VideoSettings
from gsba.disk import disk_errors, refuse_links, remove_temporaries, write_bytes, write_text
from gsba.frames.factory_start import FACTORY_FILE, write_factory_calibration
from gsba.frames.files import EXTRACTED
from gsba.frames.times import read_times
from gsba.log import GsbaError, track
from gsba.store.records import RecordError, typed
from gsba.store.store import digest, fingerprint
from gsba.trajectory.association import nearest
from gsba.trajectory.files import read_trajectory
from gsba.types import Counts
from gsba.version import __version__
from gsba.video.likeness import apparent_motion_deg, lens_interior, miniature, sharpness
from gsba.video.recording import (
    EXACT_S,
    LENSES,
    TRACKS,
    VideoPicture,
    VideoRecording,
    advice_to_end_at,
    check_lengths,
    factory_calibration_of,
    files_of,
    read_recording,
    shots,
)

logger = logging.getLogger(__name__)

TIMES = "timestamps.csv"
_JOURNAL = "extract.partial.csv"  # frames written so far; deleted when all are written
_MAX_BLACK_LEVEL = 16  # grey value; 99 % of the pixels of a black image are at or below it


@dataclass(frozen=True, slots=True)
class _Kept:
    """Frame that was written."""

    name: str  # file name
    timestamp: float  # seconds since the first frame of the video
    index: int  # number of the frame in the video
    standing: int  # number of earlier windows that were left out because the camera stood


@dataclass(frozen=True, slots=True)
class Chosen:
    """How odometry chose the frames of an extraction."""

    file: str  # name of the TUM file of their poses, beside their folder
    max_frames: int | None  # that were asked for


def extract(
    video: Path,
    out: Path,
    settings: VideoSettings,
    replace: bool = False,
    chosen_by: Chosen | None = None,
) -> Counts:
    """Write frames of a 360-degree video, 2:1, GoPro's `.360`, or raw of two lenses (see
    `gsba.video.recording`), either file of a pair, to a folder that `gsba.frames.scan` reads;
    returns numbers of frames in the range, of kept frames, and of dropped ones by reason.

    Times are the container's presentation times since the first frame, also for variable frame
    rates. An interrupted call resumes; another extraction in the folder is replaced if `replace`.
    `chosen_by` is kept for `chosen_in`. Raises GsbaError: the video or the folder cannot be used,
    or no frame is in the range.
    """
    trajectory = None if settings.at is None else Path(settings.at)
    if settings.at is not None and settings.sharpest:
        raise GsbaError("--at names the frames to keep: leave out --sharpest")
    if video.is_dir():
        raise GsbaError(f"{video} is a folder: give a video (frames need no extraction)")
    if not video.is_file():
        raise GsbaError(f"{video}: no such file")
    chosen = settings.model_copy(update={"at": None})  # its file is an input
    key = digest(__version__, chosen, fingerprint([*files_of(video), trajectory]))
    done = _take_over(out, key, replace)
    if done is not None:
        logger.info("%s: %d frames, extracted before", out, done.kept)
        return done
    recording = read_recording(video)
    windows, received = _usable_windows(video, recording, settings)
    for note in recording.notes:
        logger.info("%s", note)
    marker = _Marker(video, key, recording.folders, chosen_by)
    _write_marker(out, marker, None)
    if recording.lenses:
        found = factory_calibration_of(recording)
        if found is not None:
            write_factory_calibration(out, found)
    before = _read_journal(out, recording.folders)
    after, standing = _extract(recording, windows, out, settings, before)
    kept = before + after
    if not kept:
        raise GsbaError(f"{video}: none of its frames could be decoded; copy it again")
    left_out = {"not chosen": received - len(windows), "while the camera stood": standing}
    left_out["damaged"] = len(windows) - len(kept) - standing
    counts = Counts(received, len(kept), "frames", left_out)
    rows = "".join(f"{entry.name},{entry.timestamp!r}\n" for entry in kept)
    write_text(out / TIMES, "name,timestamp\n" + rows)
    _write_marker(out, marker, counts)
    (out / _JOURNAL).unlink(missing_ok=True)
    dropped = ", ".join(f"{n} {reason}" for reason, n in counts.dropped.items() if n)
    logger.info("%s: kept %d of %d frames (%s)", out, counts.kept, received, dropped or "all")
    return counts


def check_video(video: Path, settings: VideoSettings) -> None:
    """Refuse a video that `extract` refuses, before hours of other work."""
    _usable_windows(video, read_recording(video), settings)


def _usable_windows(
    video: Path, recording: VideoRecording, settings: VideoSettings
) -> tuple[list[np.ndarray], int]:
    """`_windows` of a video that is neither truncated nor black, nor narrower than asked for."""
    if settings.width is not None and settings.width > recording.width:
        raise GsbaError(f"--width {settings.width}: {video} has only {recording.width} pixels")
    if settings.width is not None and recording.cube:
        raise GsbaError(
            f"--width {settings.width}: tracks of a .360 recording keep their size, as lenses "
            "overlap in a whole number of columns: leave it out"
        )
    windows, received = _windows(video, recording, settings)
    _check_end(video, recording, settings.to_s)
    refuse_darkness(video, recording, [int(window[0]) for window in windows])
    return windows, received


def refuse_darkness(video: Path, recording: VideoRecording, instants: Sequence[int]) -> None:
    """Refuse a video whose middle, first and last frames, of ascending instants that are `shown`,
    are black. GsbaError: all of these frames that can be decoded are."""
    level = -1
    for row in dict.fromkeys([len(instants) // 2, 0, len(instants) - 1]):
        for _, pictures in shots(recording, [instants[row]]):
            level = max(level, *(int(np.percentile(each.luma(), 99)) for each in pictures))
        if level > _MAX_BLACK_LEVEL:
            return
    if level >= 0:
        raise GsbaError(
            f"{video}: its frames are black (99 % of their pixels at or below {level} of 255) and "
            "cannot be matched: check that the lenses were not covered"
        )


def _windows(
    video: Path, recording: VideoRecording, settings: VideoSettings
) -> tuple[list[np.ndarray], int]:
    """Groups of frame indices, of which one each is kept; and the number of frames in the range."""
    times = recording.times
    low, high = settings.from_s or 0.0, np.inf if settings.to_s is None else settings.to_s
    within = (times >= low - EXACT_S) & (times <= high + EXACT_S)
    inside = np.flatnonzero(within & recording.shown)
    if not len(inside):
        raise GsbaError(
            f"{video}: no frame between {low:g} and {high:g} s; it lasts {times[-1]:.3f} s"
        )
    if settings.at is not None:
        return _nearest_to(Path(settings.at), times, inside), len(inside)
    if settings.every is not None:
        slots = np.arange(len(inside)) // settings.every
    else:
        slots = np.floor((times[inside] - low + EXACT_S) * settings.fps).astype(np.int64)
    groups = np.split(inside, np.flatnonzero(np.diff(slots)) + 1)
    return (groups if settings.sharpest else [group[:1] for group in groups]), len(inside)


def _nearest_to(path: Path, times: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Frame nearest to each time of a trajectory, if it is within half a frame interval."""
    entries = read_trajectory(path).timestamps
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    rows = inside[nearest(times[inside], entries)]
    met = np.abs(times[rows] - entries) <= 0.5 * interval + EXACT_S
    if not met.any():
        raise GsbaError(
            f"{path}: none of its times ({entries[0]:.3f} to {entries[-1]:.3f} s) is that of a "
            f"frame (0 to {times[-1]:.3f} s): give a trajectory on the video's clock"
        )
    if not met.all():
        logger.warning("%s: %d of %d times have no frame", path, np.sum(~met), len(met))
    return [np.array([index]) for index in np.unique(rows[met])]


def _check_end(video: Path, recording: VideoRecording, to_s: float | None) -> None:
    last = float(recording.times[recording.shown][-1])
    if to_s is not None and to_s <= last + EXACT_S:
        return
    check_lengths(recording)
    if all(timeline.is_cut_short for timeline in recording.timelines):
        claimed = recording.timelines[0].claimed_s
        raise GsbaError(
            f"{video} claims to last {claimed:.1f} s, but its frames end at {last:.3f} s: it is "
            f"truncated; copy it again, or {advice_to_end_at(last)} to use the part that exists"
        )


def _extract(
    recording: VideoRecording,
    windows: list[np.ndarray],
    out: Path,
    settings: VideoSettings,
    before: list[_Kept],
) -> tuple[list[_Kept], int]:
    """Write frames after those kept `before`; kept ones, and windows left out for standing."""
    times, kept, last, journal = recording.times, list[_Kept](), None, out / _JOURNAL
    standing = before[-1].standing if before else 0
    todo = [window for window in windows if not before or window[0] > before[-1].index]
    skip_standing = settings.standing_deg > 0 and settings.at is None
    if before and todo and skip_standing:
        for _, pictures in shots(recording, [before[-1].index]):
            last = _small(pictures, recording.cube)

    def quality(shot: tuple[int, tuple[VideoPicture, ...]]) -> float:
        return sum(sharpness(p.luma()) for p in shot[1]) if settings.sharpest else 0.0

    window_of = {int(index): w for w, window in enumerate(todo) for index in window}
    windows_of_shots = groupby(shots(recording, list(window_of)), lambda shot: window_of[shot[0]])
    best = (max(window, key=quality) for _, window in windows_of_shots)
    for index, pictures in track(best, "extracting frames", len(todo)):
        if skip_standing:
            small = _small(pictures, recording.cube)
            used = lens_interior(len(small)) if recording.lenses else None
            if last is not None and apparent_motion_deg(last, small, used) < settings.standing_deg:
                standing += 1
                continue
            last = small
        name, images = f"{index:06d}.jpg", [_encoded(each, settings.width) for each in pictures]
        for folder, image in zip(_folders(out, recording.folders), images, strict=True):
            write_bytes(folder / name, image)
        kept.append(_Kept(name, float(times[index]), index, standing))
        with disk_errors(journal), journal.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(astuple(kept[-1]))
    return kept, standing


def _small(pictures: tuple[VideoPicture, ...], cube: bool) -> np.ndarray:
    """Miniature of a panorama, of two lenses side by side, or of two tracks one below the other.

    All have about the same angular width.
    """
    return miniature(np.concatenate([p.luma() for p in pictures], axis=0 if cube else 1))


def _encoded(picture: VideoPicture, width: int | None) -> bytes:
    """JPEG of a decoded image, scaled to `width` if given."""
    import cv2

    pixels = picture.bgr()
    if width is not None and width != pixels.shape[1]:
        height = width * pixels.shape[0] // pixels.shape[1]
        pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()


def _take_over(out: Path, key: str, replace: bool) -> Counts | None:
    """Prepare `out`; counts of a complete extraction with the same key, else None."""
    if out.exists() and not out.is_dir():
        raise GsbaError(f"{out} is a file: choose another --out")
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    remove_temporaries(out)
    if not any(out.iterdir()):
        return None
    refuse_links(out)
    try:
        marker = json.loads((out / EXTRACTED).read_text(encoding="utf-8"))
        counts = typed(marker["counts"], Counts | None)  # type: ignore[arg-type]
        known = (LENSES, TRACKS) if "lenses" in marker else ()
        lenses = next((names for names in known if list(names) == marker["lenses"]), LENSES[:0])
        same = marker["key"] == key
    except (OSError, ValueError, TypeError, KeyError, RecursionError, RecordError):
        raise _unlike(out) from None
    path = out / TIMES
    written = [row.name for row in read_times(path) if row.name] if path.is_file() else []
    folders = _folders(out, lenses)
    whole = path.is_file() and all((f / n).is_file() for f in folders for n in written)
    if same and (counts is None or whole):
        return counts
    if not same and not replace:
        raise GsbaError(
            f"{out} holds another extraction (of {marker.get('video')}): choose another --out, or "
            "--fresh (of extract) to replace it"
        )
    with disk_errors(out):
        names = [*written, *(kept.name for kept in _read_journal(out, lenses))]
        _remove_images(out, lenses, names)
        for name in (TIMES, FACTORY_FILE, _JOURNAL, EXTRACTED):
            (out / name).unlink(missing_ok=True)
    return None


def _folders(out: Path, lenses: Sequence[str]) -> list[Path]:
    """Folders of the images of one instant."""
    return [out / lens for lens in lenses] or [out]


def _remove_images(out: Path, lenses: Sequence[str], names: Sequence[str]) -> None:
    for folder in _folders(out, lenses):
        for name in names:
            (folder / Path(name).name).unlink(missing_ok=True)
    for folder in (out / lens for lens in lenses):
        for path in list(folder.glob("*.jpg")):
            if re.fullmatch(r"\d{6,}", path.stem):  # of one lens only, if a call was killed
                path.unlink()
        with suppress(OSError):  # the folder is missing, or holds other files
            folder.rmdir()


@dataclass(frozen=True, slots=True)
class _Marker:
    """Content of `extract.json`, the marker of a folder of extracted frames, but for counts."""

    video: Path
    key: str
    lenses: Sequence[str]
    chosen_by: Chosen | None


def _write_marker(out: Path, marker: _Marker, counts: Counts | None) -> None:
    entries: dict[str, object] = {"gsba": __version__, "video": str(marker.video.resolve())}
    entries |= {"key": marker.key, "counts": None if counts is None else asdict(counts)}
    if marker.lenses:
        entries["lenses"] = list(marker.lenses)
    if marker.chosen_by is not None:
        entries["chosen_by"] = asdict(marker.chosen_by)
    write_text(out / EXTRACTED, json.dumps(entries, indent=1, ensure_ascii=False) + "\n")


def chosen_in(out: Path) -> Chosen | None:
    """How odometry chose the frames of an extraction; None = it did not choose them, or there is
    no extraction. GsbaError: the folder holds something else."""
    if not (out.is_dir() and any(out.iterdir())):
        return None
    try:
        marker = json.loads((out / EXTRACTED).read_text(encoding="utf-8"))
        return typed(marker.get("chosen_by"), Chosen | None)  # type: ignore[arg-type]
    except (OSError, ValueError, AttributeError, RecursionError, RecordError):
        raise _unlike(out) from None


def _unlike(out: Path) -> GsbaError:
    return GsbaError(f"{out} is not empty and not an extraction: choose another --out")


def _read_journal(out: Path, lenses: Sequence[str]) -> list[_Kept]:
    """Frames that an interrupted call has written; a truncated row is ignored."""
    try:
        text = (out / _JOURNAL).read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    kept = []
    try:
        for row in csv.reader(text[: text.rfind("\n") + 1].splitlines()):
            entry = _Kept(row[0], float(row[1]), int(row[2]), int(row[3]))
            if not all((folder / entry.name).is_file() for folder in _folders(out, lenses)):
                break
            kept.append(entry)
    except (ValueError, IndexError, csv.Error) as error:
        raise GsbaError(f"{out / _JOURNAL} is damaged ({error}): remove {out}") from None
    return kept
