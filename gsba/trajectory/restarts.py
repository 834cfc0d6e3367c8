"""Trajectories in several pieces: several files, or a map that was restarted within one."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsba.config import ReadSettings
from gsba.geometry import rotation_angle
from gsba.trajectory.association import associate, nearest, poses_at
from gsba.types import CoarsePoses, FrameSet, PoseSource, Trajectory

_log = logging.getLogger(__name__)

_IDENTITY_TOLERANCE = 1e-9  # no tracked pose is this close to the identity by chance
_MIN_TURN_RAD = np.deg2rad(0.5)  # a smaller one is noise


def without_lost_frames(trajectory: Trajectory) -> Trajectory:
    """A trajectory without rows that repeat a pose because the frame was lost.

    An identity is lost where it is repeated, at the end, and where the path goes on from where it
    was before: in motion and turn together, as a new map has a scale of its own.
    Another repeated pose is lost at the end, and where the step behind it makes up for the time in
    which it was repeated; where the path goes on at its usual pace, the camera stood.

    Args:
        trajectory: N entries; at least the first of all equal poses remains.
    """
    poses, times = trajectory.world_T_rigs, trajectory.timestamps
    speeds = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / np.diff(times)
    if not (speeds > 0).any():
        return trajectory
    pace = float(np.median(speeds[speeds > 0]))
    same = (poses[1:] == poses[:-1]).all(axis=(1, 2))
    begins = np.flatnonzero(np.concatenate([[True], ~same]))
    ends = np.append(begins[1:], len(poses)) - 1
    lost = np.zeros(len(poses), bool)
    for first, last in zip(begins.tolist(), ends.tolist(), strict=True):
        if (poses[first] == np.eye(4)).all():
            lost[first : last + 1] = _lost_identity(trajectory, first, last, pace)
        elif last > first:
            lost[first + 1 : last + 1] = last + 1 == len(poses) or (
                # The steady speed is nearer to the pace than the sudden one.
                _speed(trajectory, first, last + 1) * _speed(trajectory, last, last + 1) > pace**2
            )
    if not lost.any() or np.count_nonzero(~lost) < 2:
        return trajectory
    _log.warning(
        "%d of %d rows of the trajectory without a pose, as of lost frames (they repeat the "
        "identity or the pose before; the first is of time %.6f): left out",
        lost.sum(),
        len(lost),
        times[lost][0],
    )
    return Trajectory(times[~lost], poses[~lost])


def _speed(trajectory: Trajectory, before: int, after: int) -> float:
    """Mean speed from one entry to another, units per second."""
    step = np.diff(trajectory.world_T_rigs[[before, after], :3, 3], axis=0)
    duration = np.diff(trajectory.timestamps[[before, after]])[0]
    return max(float(np.linalg.norm(step) / duration), 1e-300)


def _turn(trajectory: Trajectory, before: int, after: int) -> float:
    """Mean angular velocity from one entry to another, radians per second."""
    first, second = trajectory.world_T_rigs[[before, after], :3, :3]
    duration = np.diff(trajectory.timestamps[[before, after]])[0]
    return max(float(rotation_angle(first.T @ second)), _MIN_TURN_RAD) / float(duration)


def _lost_identity(trajectory: Trajectory, first: int, last: int, pace: float) -> np.ndarray:
    """Entries (n,) bool from `first` to `last`, all the identity, that are of lost frames."""
    rows = np.ones(last - first + 1, bool)
    if last + 1 == len(trajectory.timestamps):
        return rows
    # Of equal rows, the last one may be the first frame of a map.
    # faster than any step of the walk itself
    rows[-1] = _speed(trajectory, last, last + 1) > 4.0 * pace
    if first > 0:
        moved = _speed(trajectory, first - 1, last + 1) / _speed(trajectory, last, last + 1)
        turned = _turn(trajectory, first - 1, last + 1) / _turn(trajectory, last, last + 1)
        rows[-1] |= moved * turned < 1
    return rows


def split_restarts(trajectory: Trajectory) -> list[Trajectory]:
    """Pieces of a trajectory, in order of time, whose SLAM lost its map and began another: at an
    entry that is exactly the identity, or near it behind a jump, while the entries around keep the
    pace. A jump and another one back soon after are false poses, not a new map."""
    poses, times = trajectory.world_T_rigs, trajectory.timestamps
    lengths, intervals = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), np.diff(times)
    speeds = lengths / intervals
    if not (speeds > 0).any():
        return [trajectory]
    pace = float(np.median(speeds[speeds > 0]))
    jumps = np.flatnonzero(speeds > 4.0 * pace)  # faster than any step of the walk itself
    away, turned = np.linalg.norm(poses[:, :3, 3], axis=1), rotation_angle(poses[:, :3, :3])
    step = pace * float(np.median(intervals))
    exactly = (away < _IDENTITY_TOLERANCE) & (turned < _IDENTITY_TOLERANCE)
    nearly = (away < 3.0 * step) & (turned < np.deg2rad(20.0))
    starts = [0]
    for n in range(1, len(poses)):
        fresh = exactly[n] and not exactly[n - 1]
        if n - 1 in jumps and nearly[n]:
            # another jump within 12 entries: poses between are false
            fresh |= np.count_nonzero(np.abs(jumps - (n - 1)) <= 12) == 1
        if fresh and min(n - starts[-1], len(poses) - n) >= 3:
            starts.append(n)
    ends = [*starts[1:], len(poses)]
    return [Trajectory(times[a:b], poses[a:b]) for a, b in zip(starts, ends, strict=True)]


def associate_pieces(
    frames: FrameSet, pieces: Sequence[Trajectory], settings: ReadSettings
) -> CoarsePoses:
    """Coarse poses from pieces of a trajectory on one clock, each frame in the world of the piece
    that is nearest, the first where pieces overlap, as `segments` tell. For GsbaError see
    `associate`."""
    pieces = _in_turn(pieces)
    times = np.concatenate([piece.timestamps for piece in pieces])
    poses = np.concatenate([piece.world_T_rigs for piece in pieces])
    coarse = associate(frames, Trajectory(times, poses), settings)
    if len(pieces) == 1:
        return replace(coarse, origin=pieces[0].origin)
    owners = np.repeat(np.arange(len(pieces)), [len(piece.timestamps) for piece in pieces])
    at = frames.timestamps + coarse.time_offset
    owner = owners[nearest(times, at)]
    world_T_rigs, sources = coarse.world_T_rigs.copy(), coarse.sources.copy()
    for n, piece in enumerate(pieces):
        own = owner == n
        world_T_rigs[own] = poses_at(piece, at[own])
        outside = own & ((at < piece.timestamps[0]) | (at > piece.timestamps[-1]))
        sources[outside & (sources == PoseSource.INTERPOLATED)] = PoseSource.EXTRAPOLATED
    used, segments = np.unique(owner, return_inverse=True)
    origin = pieces[used[0]].origin
    coarse = replace(coarse, world_T_rigs=world_T_rigs, sources=sources, origin=origin)
    if len(used) == 1:
        return coarse
    _log.info("the trajectory is in %d pieces, each with a world of its own", len(used))
    return replace(coarse, segments=segments.astype(np.int32))


def _in_turn(pieces: Sequence[Trajectory]) -> list[Trajectory]:
    """Pieces in order of time, without those within the time of an earlier one."""
    kept: list[Trajectory] = []
    for piece in sorted(pieces, key=lambda piece: float(piece.timestamps[0])):
        later = piece.timestamps > kept[-1].timestamps[-1] if kept else slice(None)
        rows = piece.timestamps[later], piece.world_T_rigs[later]
        trimmed = Trajectory(*rows, piece.origin)
        if len(trimmed.timestamps) >= 2:
            kept.append(trimmed)
        else:
            _log.warning(
                "a trajectory from %.6f to %.6f s lies within the time of another: not used",
                piece.timestamps[0],
                piece.timestamps[-1],
            )
    return kept
