"""Frames of several recordings as one set: named by recording, one recording after the other."""

import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np

from gsba.log import GsbaError
from gsba.types import NO_FILE_NAME, FrameSet, PictureFormat, rows_across

_log = logging.getLogger(__name__)

_GAP_MULTIPLE_S = 100.0  # recordings begin at multiples of this many seconds


def combine(
    recordings: Mapping[str, FrameSet], cameras: Mapping[str, str] | None = None
) -> FrameSet:
    """The frames of several recordings, one recording after the other.

    Names become `RECORDING/NAME`. Clocks of different recordings say nothing of one another: times
    are shifted so that recordings follow one another, with a gap that no two neighbours have.
    Recordings of one layout, size and calibration are of one camera, unless they name different
    ones; the others have cameras of their own.

    Args:
        recordings: frames by the name of their recording, in order; each has its own clock.
        cameras: camera model by the name of a recording that names one.

    Raises:
        GsbaError: names that cannot be folders, or one recording given twice.
    """
    for name in recordings:
        if NO_FILE_NAME.search(name):
            raise GsbaError(f"recording {name!r:.60}: the name cannot be that of a folder")
    for (name, one), (other_name, other) in combinations(recordings.items(), 2):
        _refuse_same(name, one, other_name, other)
        first, second = one.timestamps, other.timestamps
        if one.timed and other.timed and first[0] <= second[-1] and second[0] <= first[-1]:
            both = "times of recordings '%s' and '%s' overlap: each has a clock of its own"
            _log.info(both, name, other_name)
    parts = list(recordings.values())
    formats, numbers = _cameras_of(recordings, cameras or {})
    gap = 100.0 * max(float(np.median(np.diff(part.timestamps))) for part in parts)
    times, shifts, end = list[np.ndarray](), list[float](), -gap
    for part in parts:
        begin = _GAP_MULTIPLE_S * math.ceil((end + gap) / _GAP_MULTIPLE_S)
        shift = begin - float(part.timestamps[0])
        times.append(part.timestamps + shift)
        shifts += [shift] * len(part)
        end = float(times[-1][-1])
    timed = tuple(part.timed for part in parts for _ in range(len(part)))
    return FrameSet(
        names=tuple(f"{name}/{own}" for name, part in recordings.items() for own in part.names),
        paths=tuple(paths for part in parts for paths in part.paths),
        timestamps=np.concatenate(times),
        mask_paths=tuple(path for part in parts for path in part.mask_paths),
        formats=formats,
        camera_of_frame=tuple(
            number for number, part in zip(numbers, parts, strict=True) for _ in range(len(part))
        )
        if len(formats) > 1
        else (),
        clock_shifts=tuple(shifts),
    ).with_timed(timed)


def own_timestamps(frames: FrameSet) -> np.ndarray:
    """Times (F,) of frames on the clocks of their recordings, seconds."""
    shifts = frames.clock_shifts
    return frames.timestamps - np.array(shifts) if shifts else frames.timestamps


def names_of_cameras(frames: FrameSet) -> list[str]:
    """Name of each camera: that of the first of its recordings; "" of the only one."""
    names = [""] * len(frames.formats)
    for name, rows in reversed(frames.recordings.items()):
        names[frames.cameras[rows[0]]] = name
    return names


def _refuse_same(name: str, one: FrameSet, other_name: str, other: FrameSet) -> None:
    """Refuse two recordings whose pictures are the same files, or copies."""
    common = set(one.paths) & set(other.paths)
    if common:
        shared = min(str(paths[0]) for paths in common)
        raise GsbaError(
            f"recordings '{name}' and '{other_name}' are the same ({shared}): give each one once"
        )
    if len(one) != len(other):
        return
    # frames whose files are compared, to tell a recording given twice
    rows = rows_across(len(one), 3)
    pairs = [pair for f in rows for pair in zip(one.paths[f], other.paths[f], strict=False)]
    if all(
        a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes() for a, b in pairs
    ):
        raise GsbaError(
            f"recordings '{name}' and '{other_name}' hold the same pictures "
            f"({pairs[0][0]} and {pairs[0][1]}): give each recording once"
        )


def _cameras_of(
    recordings: Mapping[str, FrameSet], names: Mapping[str, str]
) -> tuple[tuple[PictureFormat, ...], list[int]]:
    """Format (C,) of each camera, and the camera (R,) of each recording, by the models' `names`."""
    formats, models, numbers = list[PictureFormat](), list[str](), list[int]()
    for recording, frames in recordings.items():
        own, model = frames.format, names.get(recording, "")
        for number, (known, other) in enumerate(zip(formats, models, strict=True)):
            if one_mode(known, own) and (not model or not other or model == other):
                nominal = known.lenses_nominal or own.lenses_nominal
                formats[number] = replace(known, lenses_nominal=nominal)
                models[number] = other or model
                break
        else:
            number = len(formats)
            formats.append(own)
            models.append(model)
        numbers.append(number)
    return tuple(formats), numbers


def one_mode(one: PictureFormat, other: PictureFormat) -> bool:
    """True if one camera in one mode can have made both; lenses that are to be estimated may
    differ."""
    if one.lenses_nominal or other.lenses_nominal:
        other = replace(other, fisheyes=one.fisheyes, lenses_nominal=one.lenses_nominal)
    return one == other
