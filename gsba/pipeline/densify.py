"""More frames of a video between those where the map is weak; they stay out of datasets unless
asked for."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsba import video
from gsba.config import RefineSettings
from gsba.frames.times import read_times
from gsba.odometry.walk import Odometry, write_chosen
from gsba.pipeline.prior import Prior
from gsba.store.store import RunStore, fingerprint
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

FOLDER = Path("fetched")  # in a run's folder: frames fetched in each round
_MAX_SHARE = 3.0  # fetched frames, part of those that were chosen
_MAX_DRIFT = 3e-4  # predicted position error relative to the path; maps above it get more frames


def fetch_where_weak(
    store: RunStore,
    video_file: Path,
    walk: Odometry,
    frames: FrameSet,
    settings: RefineSettings,
    measure: Callable[[FrameSet], Prior],
    known: Sequence[object] = (),
) -> FrameSet:
    """Frames of a run, and between weak ones more of the video, until the map that `measure` solves
    is strong, no frames are left between, or `odometry.fetch_rounds` are over; `known`: what that
    map rests on beside frames and settings."""
    if len(set(frames.mask_paths)) > 1:
        logger.info("no frames are fetched: each frame has a mask of its own")
        return frames
    chosen = len(frames)
    for n in range(settings.odometry.fetch_rounds):
        left = int((1 + _MAX_SHARE) * chosen) - len(frames)
        name = f"fetch{n}"
        paths = [path for group in frames.paths for path in group] + list(set(frames.mask_paths))
        key = [settings.model_dump(exclude={"export", "placement"}), fingerprint(paths)]
        key += [frames.formats, *known]
        rows = store.stored(name, key, np.ndarray, ())
        if rows is None:
            steps = weak_steps(measure(frames))
            rows = rows_between(walk, frames.timestamps, steps, left)
            store.stage(name, key, lambda rows=rows: rows, np.ndarray)
        if not len(rows):
            break
        logger.info(
            "the map is weak in places: %d more frames of the video, round %d",
            len(rows),
            n + 1,
        )
        frames = _with_rows(store, video_file, walk, frames, settings, rows, n)
    return frames


def weak_steps(prior: Prior) -> np.ndarray:
    """Steps (F - 1,) bool between frames that images hold poorly, or do not show.

    These are steps that no image shows or that nothing ties together; and of maps that drift, those
    that hand on the scale less well than half of them do.
    """
    weak = prior.trust.unseen_steps.copy()
    if prior.merged is not None:
        weak |= np.diff(prior.merged.components) != 0
        weak |= prior.merged.lost[:-1] | prior.merged.lost[1:]
    if prior.strength is not None:
        maps = np.zeros(len(weak) + 1, np.int64) if prior.parts is None else prior.parts
        sigmas = np.pad(prior.strength.scale_sigmas, 1, constant_values=np.nan)
        for number in np.flatnonzero(prior.strength.drift > _MAX_DRIFT).tolist():
            known = (maps == number) & np.isfinite(sigmas)
            if known.any():
                poor = known & (sigmas >= np.median(sigmas[known]))
                weak |= poor[:-1] | poor[1:]
    return weak


def rows_between(walk: Odometry, times: np.ndarray, steps: np.ndarray, most: int) -> np.ndarray:
    """Rows (N,) of an odometry to fetch, at most `most`: of steps (F - 1,) bool between times (F,),
    seconds, the sharpest frame of the middle third."""
    posed, rows = np.flatnonzero(walk.posed()), []
    half = 0.5 * float(np.median(np.diff(walk.timestamps)))
    for f in np.flatnonzero(steps).tolist():
        inside = (walk.timestamps[posed] > times[f] + half) & (
            walk.timestamps[posed] < times[f + 1] - half
        )
        free = posed[inside]
        third = free[len(free) // 3 : len(free) - len(free) // 3]
        if len(third):
            rows.append(int(third[np.argmax(walk.sharpness[third])]))
    if len(rows) > most:
        rows = [rows[n] for n in np.linspace(0, len(rows) - 1, max(most, 0)).astype(int)]
    return np.array(rows, np.int64)


def _with_rows(
    store: RunStore,
    video_file: Path,
    walk: Odometry,
    frames: FrameSet,
    settings: RefineSettings,
    rows: np.ndarray,
    number: int,
) -> FrameSet:
    """Frames, and rows (N,) of the odometry besides, extracted to a folder of their own."""
    folder, before = store.root / FOLDER / f"{number}", store.root / "frames"
    at = store.root / FOLDER / f"{number}.tum"
    if len(rows) == 1:  # a file of poses has two at least: one that is there already goes with it
        known = int(np.argmin(np.abs(walk.timestamps - frames.timestamps[0])))
        rows = np.unique([known, *rows])
    write_chosen(walk, rows, at)
    asked = settings.video.model_copy(
        update={"at": str(at), "sharpest": False, "every": None, "standing_deg": 0.0}
    )
    video.extract(video_file, folder, asked, replace=True)
    store.claim(store.root / FOLDER)
    like = [path.relative_to(before.absolute()).parent for path in frames.paths[0]]
    found = {
        Path(row.name or "").stem: row.timestamp for row in read_times(folder / "timestamps.csv")
    }
    table = {name: time for name, time in found.items() if name not in frames.names}
    new = {n: tuple((folder / part / f"{n}.jpg").absolute() for part in like) for n in table}
    names, times = (*frames.names, *table), [*frames.timestamps.tolist(), *table.values()]
    order = np.argsort(times, kind="stable")
    paths = (*frames.paths, *new.values())
    fetched = (*(frames.fetched or (False,) * len(frames)), *(True for _ in table))
    return replace(
        frames,
        names=tuple(names[f] for f in order),
        paths=tuple(paths[f] for f in order),
        timestamps=np.array(times)[order],
        mask_paths=(frames.mask_paths[0],) * len(order),
        fetched=tuple(fetched[f] for f in order),
    )
