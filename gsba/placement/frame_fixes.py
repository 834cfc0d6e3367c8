"""GPS fixes of a run's frames, from files of all kinds, interpolated at the frames' times."""

import logging
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba.bundle.gps_factors import FrameFixes
from gsba.config import GpsSettings
from gsba.frames.exif import GpsTag, read_exif
from gsba.frames.recordings import own_timestamps
from gsba.log import GsbaError, track
from gsba.placement.gps import GpsFixes, fixes_of, local_from_geodetic, read_gps, sigmas_of
from gsba.placement.gps_video import RECORDINGS, read_video_gps
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

EXIF = "exif"  # in place of a file: positions in the EXIF data of the images
MIN_FIXES = 3
_UNIX_S = 1e9  # clocks that show more show Unix time: September 2001


def read_exif_gps(frames: FrameSet, settings: GpsSettings | None = None) -> GpsFixes:
    """Fixes of the frames whose images have GPS tags, by name, without those that repeat an earlier
    frame's position and time; unknown altitudes as of `fixes_of`. GsbaError if fewer than three
    frames have a fix, or an image cannot be read."""
    found: dict[str, GpsTag] = {}
    taken, damaged = set[tuple[float, float, float]](), 0
    for name, paths in zip(frames.names, track(frames.paths, "reading EXIF"), strict=True):
        tag = None
        for path in paths:  # the first image of the frame that has a position
            try:
                tag = tag or read_exif(path).gps
            except ValueError:
                damaged += 1
        if tag is None:
            continue
        known = tag.latitude, tag.longitude, tag.unix_time
        if math.isnan(tag.unix_time) or known not in taken:
            found[name] = tag
        taken.add(known)
    if damaged:
        logger.warning("--gps exif: the EXIF data of %d images are damaged", damaged)
    if len(found) < MIN_FIXES:
        raise GsbaError(
            f"--gps exif: {len(found)} of {len(frames)} frames have GPS tags "
            f"('{frames.paths[0][0]}' is the first frame), and {MIN_FIXES} are needed: "
            "give positions as --gps FILE, CSV or GPX"
        )
    tags, settings = list(found.values()), settings or GpsSettings()
    geodetic = np.array([[tag.latitude, tag.longitude, tag.altitude] for tag in tags])
    dop, error = (np.array([getattr(tag, key) for tag in tags]) for key in ("dop", "error_m"))
    fixes = fixes_of(list(found), geodetic, sigmas_of(settings, dop, error_m=error), settings)
    logger.info("--gps exif: %d of %d frames have a position", len(fixes.geodetic), len(frames))
    return fixes


def read_fixes(
    source: str, frames: FrameSet | None = None, settings: GpsSettings | None = None
) -> GpsFixes | None:
    """Fixes of the source that `--gps` names: a CSV or GPX file, a video, or "exif" of the frames,
    None where these are not known yet. GsbaError names the line that cannot be read."""
    if source == EXIF:
        return None if frames is None else read_exif_gps(frames, settings)
    read = read_video_gps if Path(source).suffix.lower() in RECORDINGS else read_gps
    return read(Path(source), settings)


def fixes_of_frames(
    source: str,
    frames: FrameSet,
    settings: GpsSettings | None = None,
    whole: FrameSet | None = None,
) -> FrameFixes:
    """Fixes of frames by name, or interpolated between the fixes before and after. Names without a
    recording are of the first one: fixes of a run stay when recordings are added.

    A receiver without a lock writes latitude 0 and longitude 0, or its last place again and again:
    both are left out, so that of equal places in a row the first remains.

    Between fixes that are `d` seconds apart, a pedestrian deviates from the straight line by up to
    `a d^2 / 8`, a = 1 m/s^2. This deviation is added to the noise; frames where it exceeds the
    noise of the fixes have no fix.

    Args:
        frames: frames of the run; they need times unless fixes name frames.
        settings: smallest noise of the fixes.
        whole: all frames of the run, of which `frames` are a map: its recordings are those that
            the source is of; None = `frames` are all.

    Raises:
        GsbaError: the source cannot be read, its receiver had no lock, or its times do not overlap
            with the frames'.
    """
    some, frames = frames, whole or frames
    fixes = read_fixes(source, frames, settings)
    assert fixes is not None  # frames are known
    fixes = _locked(source, fixes)
    if fixes.names is None:
        rows, geodetic, sigmas = _between(source, fixes, frames)
    else:
        recordings = list(frames.recordings)
        head = f"{recordings[0]}/" if recordings else ""
        parts = [name.rpartition("/") for name in fixes.names]  # a table's names may have a folder
        by_name = {
            "".join(some) if some[0] in recordings else head + some[2]: g
            for g, some in enumerate(parts)
        }
        rows = np.array([f for f, name in enumerate(frames.names) if name in by_name], np.int64)
        chosen = [by_name[frames.names[f]] for f in rows]
        geodetic, sigmas = fixes.geodetic[chosen], fixes.sigmas[chosen]
    if whole is not None:
        numbers = {name: f for f, name in enumerate(some.names)}
        among = np.array([numbers.get(frames.names[f], -1) for f in rows], np.int64)
        rows, geodetic, sigmas = (each[among >= 0] for each in (among, geodetic, sigmas))
        frames = some
    origin = np.median(geodetic, axis=0) if len(rows) else np.zeros(3)
    local = local_from_geodetic(geodetic, origin)
    times = frames.timestamps[rows] if frames.timed_frames[rows].all() else None
    origin[1] = (origin[1] + 180) % 360 - 180
    return FrameFixes(rows, local, sigmas, times, origin, correlation_s=60.0)  # see `FrameFixes`


def _locked(source: str, fixes: GpsFixes) -> GpsFixes:
    """Fixes without those that a receiver writes while it has no lock."""
    places = fixes.geodetic[:, :2]
    locked = (places != 0).any(axis=1)
    if not locked.any():
        raise GsbaError(
            f"{source}: all {len(places)} positions are latitude 0, longitude 0: the receiver had "
            "no fix; leave out --gps"
        )
    locked[1:] &= (places[1:] != places[:-1]).any(axis=1)
    if len(places) > 1 and locked.sum() == 1:
        raise GsbaError(
            f"{source}: all {len(places)} positions are equal: the receiver repeated one fix; "
            "leave out --gps"
        )
    if locked.all():
        return fixes
    logger.warning(
        "--gps %s: %d of %d positions are no fixes: they are latitude 0, longitude 0, or repeat "
        "the position before",
        source,
        np.sum(~locked),
        len(places),
    )
    rows = np.flatnonzero(locked).tolist()
    return replace(
        fixes,
        names=None if fixes.names is None else tuple(fixes.names[g] for g in rows),
        timestamps=None if fixes.timestamps is None else fixes.timestamps[locked],
        geodetic=fixes.geodetic[locked],
        sigmas=fixes.sigmas[locked],
    )


def _on_one_clock(source: str, frames: FrameSet, times: np.ndarray) -> np.ndarray:
    """Frames (F,) bool without those of recordings whose clocks, unless they are Unix time, show
    times (F,) of an earlier one: they count from recordings' starts, and fixes are of the first."""
    told, spans = np.ones(len(times), bool), list[tuple[float, float]]()
    for name, rows in frames.recordings.items():
        begin, end = float(times[rows].min()), float(times[rows].max())
        if begin < _UNIX_S and any(begin <= other[1] and other[0] <= end for other in spans):
            told[rows] = False
            logger.warning(
                "--gps %s: its times are those of an earlier recording, not of '%s', whose clock "
                "shows the same: give positions of both by name, as '%s'",
                source,
                name,
                frames.names[rows[0]],
            )
        else:
            spans.append((begin, end))
    return told


def _between(
    source: str, fixes: GpsFixes, frames: FrameSet
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frames (G,) between fixes, their positions (G, 3) geodetic, and sigmas (G, 3) in metres."""
    times, entries = own_timestamps(frames), fixes.timestamps
    assert entries is not None
    if not frames.timed_frames.any():
        raise GsbaError(
            f"{source}: the frames have no times to interpolate positions at: refine with "
            "--timestamps"
        )
    within = (times >= entries[0]) & (times <= entries[-1]) & _on_one_clock(source, frames, times)
    inside = np.flatnonzero(within & frames.timed_frames)
    if not len(inside):
        raise GsbaError(
            f"{source}: no overlap in time: positions span {entries[0]:.3f} to {entries[-1]:.3f} "
            f"s, frames {times[0]:.3f} to {times[-1]:.3f} s; give both on one clock, "
            "or the seconds to add to the positions' times (--gps-offset SECONDS of export; of "
            "refine, --set gps.offset_s=SECONDS)"
        )
    after = np.clip(np.searchsorted(entries, times[inside]), 1, max(len(entries) - 1, 1))
    after = np.minimum(after, len(entries) - 1)
    before = np.maximum(after - 1, 0)
    gaps = entries[after] - entries[before]
    part = np.where(gaps > 0, (times[inside] - entries[before]) / np.maximum(gaps, 1e-12), 0.0)

    def mixed(columns: np.ndarray) -> np.ndarray:
        return columns[before] + part[:, None] * (columns[after] - columns[before])

    noise = mixed(fixes.sigmas)
    # Pedestrians accelerate by 1 m/s^2: this bounds the deviation from the line between fixes.
    stray = gaps**2 / 2 * part * (1 - part)
    near = stray <= noise[:, 0]
    total = np.hypot(noise, stray[:, None])
    return inside[near], mixed(fixes.geodetic)[near], total[near]
