"""Times of frames and poses: tables on disk, frame rates, file names, EXIF tags."""

import logging
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.frames.exif import ExifTags, read_exif
from gsba.frames.files import IMAGE_SUFFIXES
from gsba.log import GsbaError, brief, track

_log = logging.getLogger(__name__)

_TICKS_PER_SECOND = {
    "seconds": 1,
    "milliseconds": 10**3,
    "microseconds": 10**6,
    "nanoseconds": 10**9,
}

_FPS_RANGE = (1e-6, 1e6)  # range of --fps, frames per second
_MIN_INTERVAL_S = 1e-3  # frame intervals shorter than this are numbering, not times
_ADVICE = "pass --timestamps FILE or --fps F, or put a timestamps.csv (name,timestamp) beside them"
_DATE = r"(19|20)[0-9]{2}[-_]?(0[1-9]|1[0-2])[-_]?([0-2][0-9]|3[01])"  # in a name


class NoTimesError(GsbaError):
    """No source gives the times of frames."""


@dataclass(frozen=True, slots=True)
class TimeRow:
    """One line of a table of times."""

    line: int  # 1-based
    name: str | None  # file name as written; None in a plain list
    timestamp: float  # seconds


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Numbered lines of a text file without blank lines and # comments. Raises GsbaError: the file
    is missing, unreadable or not text."""
    try:
        if path.is_dir() or path.is_char_device() or path.is_block_device():
            raise GsbaError(f"{path}: is a folder or a device; give a text file")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise GsbaError(f"{path}: not a text file") from None
    stripped = ((number, line.strip()) for number, line in enumerate(text.split("\n"), 1))
    return [(number, line) for number, line in stripped if line and not line.startswith("#")]


def seconds(text: str) -> float:
    """Seconds written as a decimal number, or as Unix time in whole ms, us or ns. Raises
    ValueError: the text is no finite number, or no clock shows it."""
    unit = unix_unit(text)
    value = int(text) / _TICKS_PER_SECOND[unit] if unit else float(text)
    # even nanoseconds since 1970, read as seconds, are below
    if not abs(value) <= 1e20:
        raise ValueError(text)
    return value


def unix_unit(text: str) -> str | None:
    """Unit in which a whole number is a Unix time of this century; None if in none."""
    if not re.fullmatch(r"[0-9]+", text):
        return None
    low, high = 1_000_000_000, 4_102_444_800  # Unix times between 2001 and 2100
    return next((u for u, t in _TICKS_PER_SECOND.items() if low * t <= int(text) < high * t), None)


def read_times(path: Path) -> list[TimeRow]:
    """Rows of a table of times: `name,timestamp`, `timestamp name`, or one timestamp a line.

    A header is optional. Columns are separated by commas or blanks. Raises GsbaError: a line is
    malformed; the message names it.
    """
    lines = read_lines(path)
    rows = [
        (number, [p.strip() for p in line.split(",")] if "," in line else line.split())
        for number, line in lines
    ]
    header = rows.pop(0)[1] if rows and not any(map(_is_seconds, rows[0][1])) else None
    if not rows:
        raise GsbaError(f"{path}: holds no times")
    columns = len(rows[0][1])
    if columns > 2:
        raise GsbaError(f"{path}: {columns} columns; want name,timestamp or one timestamp a line")
    if header:
        time_first = header[0].lower().startswith("time")
    else:  # `timestamp name` where only the first column is numbers
        time_first = all(_is_seconds(cells[0]) for _, cells in rows)
        time_first &= not all(_is_seconds(cells[-1]) for _, cells in rows)
    table = []
    for number, cells in rows:
        if len(cells) != columns:
            raise GsbaError(f"{path}:{number}: {len(cells)} columns where others have {columns}")
        name, time = (cells[-1], cells[0]) if time_first else (cells[0], cells[-1])
        if not _is_seconds(time):
            raise GsbaError(f"{path}:{number}: '{brief(time)}' is not a time in seconds")
        table.append(TimeRow(number, name if columns == 2 else None, seconds(time)))
    return table


def _is_seconds(text: str) -> bool:
    try:
        seconds(text)
    except ValueError:
        return False
    return True


def frame_times(
    names: Sequence[str],
    table: Path | None,
    fps: float | None,
    order_suffices: bool = False,
    pictures: Sequence[Sequence[Path]] = (),
) -> tuple[np.ndarray, bool]:
    """Time of each frame from a table, a rate, the names themselves, or EXIF tags.

    Args:
        names: (F,) frame names without extension, in name order.
        table: file that `read_times` understands; a plain list is in name order.
        fps: frames per second of these very frames: frame i is at i / fps.
        order_suffices: use the order of the names, and numbers that they skip, where no source
            gives times.
        pictures: (F,) files of each frame, whose EXIF tags are read last.

    Returns:
        (F,) float64 seconds, not necessarily sorted, and whether they are times.

    Raises:
        GsbaError: a frame has no time, or its time would have to be guessed.
    """
    if table is not None:
        rows = read_times(table)
        if rows[0].name is None:
            if len(rows) != len(names):
                raise GsbaError(
                    f"{table}: {len(rows)} times for {len(names)} frames; give one a frame in name "
                    "order, or name,timestamp rows"
                )
            return np.array([row.timestamp for row in rows]), True
        by_name: dict[str, float] = {}
        for row in rows:
            name = stem_of(row.name or "")
            if name in by_name:
                raise GsbaError(f"{table}:{row.line}: a second time for frame '{name}'")
            by_name[name] = row.timestamp
        missing = [name for name in names if name not in by_name]
        if missing:
            raise GsbaError(
                f"{table}: no time for frame '{missing[0]}' "
                f"({len(missing)} of {len(names)} missing)"
            )
        if len(by_name) > len(names):
            _log.info("%s: %d rows name no frame here", table, len(by_name) - len(names))
        return np.array([by_name[name] for name in names]), True
    try:
        if fps is not None:
            given = _times_at_rate(names, check_fps(fps))
        else:
            given = _times_from_names(names)
            if given is None:
                given = _times_from_exif(names, pictures)
    except NoTimesError as error:
        if not order_suffices:
            raise
        _log.info("frames are taken in the order of their names (%s)", error)
        if films := _films(names):
            _log.warning(
                "names of frames are numbered anew after %s: if these are several films, give each "
                "a folder of its own (gsba refine A B --out RUN), as a place that looks alike may "
                "join them",
                ", ".join(f"'{name}'" for name in films),
            )
        return _relative_times(names) / (fps or 1.0), False
    return given, True


def check_fps(fps: float) -> float:
    """The frame rate, if it is valid. Raises GsbaError: the rate is not positive, or no camera has
    it."""
    if not _FPS_RANGE[0] <= fps <= _FPS_RANGE[1]:
        raise GsbaError(
            f"--fps {fps}: must be a positive number of frames per second, from "
            f"{_FPS_RANGE[0]:g} to {_FPS_RANGE[1]:g}"
        )
    return fps


def stem_of(name: str) -> str:
    """A frame's name: a file name without folder and image suffix."""
    path = Path(name.replace("\\", "/"))
    return path.stem if path.suffix.lower() in IMAGE_SUFFIXES else path.name


def _times_at_rate(names: Sequence[str], fps: float) -> np.ndarray:
    counters = [int(m[0]) for name in names if (m := re.search(r"[0-9]{1,18}$", name))]
    steps = np.diff(counters)
    skips = np.flatnonzero(steps != np.median(steps)) if len(counters) == len(names) else []
    if 0 < len(skips) <= len(steps) / 2:  # counters are mostly even, with gaps
        before, after = names[skips[0]], names[skips[0] + 1]
        raise NoTimesError(
            f"frame numbers skip between '{before}' and '{after}', so --fps alone does not give "
            "their times; pass --timestamps FILE"
        )
    return np.arange(len(names)) / fps


def _relative_times(names: Sequence[str]) -> np.ndarray:
    """Numbers (F,) that names end in, from 0, in units of their usual step; else names' order."""
    order, digits = np.arange(len(names), dtype=np.float64), _last_digits(names)
    if len(names) < 2 or digits is None or any(re.search(_DATE, name) for name in names):
        return order
    numbers = np.array([float(int(one) - int(digits[0])) for one in digits])
    steps = np.diff(numbers)
    usual = float(np.median(steps))
    even = usual > 0 and 2 * np.count_nonzero(steps == usual) > len(steps) and steps.min() > 0
    return numbers / usual if even else order


def _films(names: Sequence[str]) -> list[str]:
    """Parts of names before their last digits, if there are several, each of three frames or more;
    [] = all are of one film."""
    counts = Counter(prefix for prefix, _ in _numbered(names))
    return list(counts) if len(counts) > 1 and min(counts.values()) >= 3 else []


def _last_digits(names: Sequence[str]) -> list[str] | None:
    """Digits (F,) that names end in after a common prefix; None = other names."""
    found = _numbered(names)
    if not all(digits for _, digits in found) or len({prefix for prefix, _ in found}) != 1:
        return None
    return [digits for _, digits in found]


def _numbered(names: Sequence[str]) -> list[tuple[str, str]]:
    """Each name's prefix and the digits that it ends in; both empty where there are none."""
    split = [re.fullmatch(r"(.*?)([0-9]+)", name) for name in names]
    return [(m[1], m[2]) if m else ("", "") for m in split]


def _times_from_names(names: Sequence[str]) -> np.ndarray | None:
    """Times of names that are decimal seconds or, after one prefix, Unix times; None = others."""
    if all(re.fullmatch(r"[0-9]+\.[0-9]+", name) for name in names):
        times = np.array([float(name) for name in names])
        if np.median(np.diff(np.sort(times))) < _MIN_INTERVAL_S:
            raise NoTimesError(f"names like '{names[0]}' are too close to be seconds; {_ADVICE}")
        _log.info("frame times are the file names, in seconds")
        return times
    digits = _last_digits(names) or []
    units = {unix_unit(one) for one in digits}
    if len(units) == 1 and None not in units:
        _log.info("frame times are the file names, Unix time in %s", units.pop())
        return np.array([seconds(one) for one in digits])
    return None


def _times_from_exif(names: Sequence[str], pictures: Sequence[Sequence[Path]]) -> np.ndarray:
    """Times of DateTimeOriginal and SubSecTimeOriginal, Unix time where the zone is given."""
    tags = [_time_tags(files) for files in track(pictures, "reading EXIF")]
    why, taken = _why_exif_is_unusable(names, tags), [tag.taken for tag in tags if tag is not None]
    if not taken or why:
        unused = f"; EXIF times are not used: {why}" if why else ""
        first = f"the frames ('{names[0]}', ...)"
        raise NoTimesError(f"no source gives the times of {first}{unused}; {_ADVICE}")
    zoned = all(tag is not None and tag.zoned for tag in tags)
    what = "Unix time" if zoned else "local time, as no time zone is given"
    whole = "" if any(tag is not None and tag.subsecond for tag in tags) else ", in whole seconds"
    _log.info("frame times are those of EXIF, %s%s", what, whole)
    return np.array(taken, np.float64)


def _why_exif_is_unusable(names: Sequence[str], tags: Sequence[ExifTags | None]) -> str:
    """Reason why EXIF times cannot be used; empty = they can, or no picture has one."""
    dated = [tag for tag in tags if tag is not None]
    if dated and len(dated) < len(tags):
        lacking = next(name for name, tag in zip(names, tags, strict=True) if tag is None)
        return f"{len(dated)} of {len(names)} frames have one, not '{lacking}'"
    if len({tag.zoned for tag in dated}) > 1:
        return "some name a time zone, others do not"
    taken = np.array([tag.taken for tag in dated], np.float64)
    late = np.flatnonzero(np.diff(taken) <= 0)
    if not len(late):
        return ""
    pair = f"'{names[late[0]]}' and '{names[late[0] + 1]}'"
    if taken[late[0]] > taken[late[0] + 1]:
        return f"{pair} are in another order by them than by name"
    whole = "" if any(tag.subsecond for tag in dated) else ": they are whole seconds"
    return f"{pair} have the same one{whole}"


def _time_tags(files: Sequence[Path]) -> ExifTags | None:
    """Tags of the first picture of a frame that has a time; None = none has."""
    for path in files:
        try:
            tags = read_exif(path)
        except ValueError:  # damaged
            continue
        if tags.taken is not None:
            return tags
    return None
