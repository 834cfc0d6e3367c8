"""Tracking of a whole sequence, which can be interrupted and goes on from a checkpoint."""

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsba import __version__
from gsba.log import event, track
from gsba.odometry.panoramas import SmallPanoramas
from gsba.odometry.places import compressed
from gsba.odometry.tracker import Tracker
from gsba.odometry.tracker_state import TrackerState
from gsba.store.records import load_checkpoint, save_record
from gsba.store.shards import content_digest
from gsba.store.store import fingerprint
from gsba.video.likeness import sharpness

logger = logging.getLogger(__name__)

_PATIENCE_S, _MIN_PATIENCE = 1.5, 8  # seconds, and frames, before a lost camera begins a new map
_CHECKPOINT_S = 60.0  # between checkpoints
_MAX_SAVING_SHARE = 0.03  # of the time between checkpoints that writing one may take
_POINTS_TOLD = 12  # most points of a keyframe that its event holds


@dataclass(slots=True)
class Tracking:
    """A sequence as far as it was tracked."""

    state: TrackerState = field(default_factory=TrackerState)
    rows: list[int] = field(default_factory=list)  # panoramas that could be read
    sharpness: list[float] = field(default_factory=list)  # of each; see gsba.video.likeness
    pictures: list[np.ndarray] = field(default_factory=list)  # (n,) uint8 each, keyframes as JPEG
    cpu_s: float = 0.0  # processor time, decoding apart


def track_frames(panoramas: SmallPanoramas, seed: int, checkpoint: Path | None) -> Tracking:
    """Pose all frames of a sequence one after another.

    Args:
        panoramas: in time order; those that are damaged are left out.
        checkpoint: written each minute; where it is of these panoramas, tracking goes on from it.
            The caller removes it. None = there is none.

    Raises:
        GsbaError: the disk refuses a checkpoint.
    """
    num, interval = len(panoramas), float(np.median(np.diff(panoramas.timestamps)))
    patience = max(_MIN_PATIENCE, round(_PATIENCE_S / interval))
    key = _key(panoramas, seed, patience) if checkpoint is not None else ""
    found = load_checkpoint(checkpoint, key, Tracking, "tracking begins anew") or Tracking()
    if found.rows:
        logger.info("tracking goes on after %d frames, from %s", len(found.rows), checkpoint)
    state, first = found.state, found.rows[-1] + 1 if found.rows else 0
    tracker = Tracker(panoramas.width, panoramas.usable, seed, patience, state)
    gone, due = _DistanceGone(state), time.monotonic() + _CHECKPOINT_S
    for number in range(len(state.keyframe_poses)):
        _tell_keyframe(state, number)
    pictures = panoramas.read(range(first, num), False)
    for row, grey in track(pictures, "tracking", num, first, gone):
        began = time.thread_time()
        tracker.add(grey)
        found.sharpness.append(sharpness(grey))
        found.rows.append(row)
        while len(state.keyframe_frames) > len(found.pictures):
            found.pictures.append(compressed(grey))
            _tell_keyframe(state, len(found.pictures) - 1)
        found.cpu_s += time.thread_time() - began
        if checkpoint is not None and (began := time.monotonic()) > due:
            save_record(checkpoint, found, {"key": key})
            now = time.monotonic()
            due = now + max(_CHECKPOINT_S, (now - began) / _MAX_SAVING_SHARE)
    return found


def _tell_keyframe(state: TrackerState, number: int) -> None:
    """Pass a keyframe on as an event: its map, its position, some of the points that it sees."""
    ids, _ = state.keyframe_features[number]
    points = state.points[ids]
    points = points[np.isfinite(points).all(axis=1)]
    points = points[:: max(1, -(-len(points) // _POINTS_TOLD))]
    position = state.keyframe_poses[number][:3, 3]
    map_number = state.records[state.keyframe_frames[number]].map_number
    told = {"position": position.round(4).tolist(), "points": points.round(4).tolist()}
    event("keyframe", map=map_number, **told)


@dataclass(slots=True)
class _DistanceGone:
    """Length of the path so far, for the progress bar; from one map to the next there is none."""

    state: TrackerState
    keyframes: int = 1  # that are counted
    length: float = 0.0  # map units

    def __call__(self) -> str:
        state, poses = self.state, self.state.keyframe_poses
        for n in range(self.keyframes, len(poses)):
            ends = state.keyframe_frames[n - 1 : n + 1]
            if len({state.records[f].map_number for f in ends}) == 1:
                self.length += float(np.linalg.norm(poses[n][:3, 3] - poses[n - 1][:3, 3]))
        self.keyframes = max(len(poses), 1)
        return f"{self.length:.1f} units gone"


def _key(panoramas: SmallPanoramas, seed: int, patience: int) -> str:
    """Digest of all that tracking rests on."""
    usable = np.ones(0, bool) if panoramas.usable is None else panoramas.usable
    source = panoramas.source  # a folder is dated anew whenever something is written to it
    files = fingerprint([source]) if source.is_file() else str(source)
    what = panoramas.width, seed, patience, __version__
    return content_digest(files, panoramas.timestamps, usable, what)
