"""Pieces of a trajectory, each with an origin and a scale of its own, moved into one world by
guesses at a constant pace; points that they share join them later
(`gsba.loop_closure.map_merging`)."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import typical_length
from gsba.similarity import Sim3
from gsba.types import CoarsePoses

PLACES, GUESS = "points that both know", "guess: the same pace"


@dataclass(frozen=True, slots=True)
class SegmentAlignment:
    """Similarity of a piece of the trajectory to the world of the first: x = scale * R @ own +
    t."""

    first: int  # its first frame
    last: int  # its last frame
    scale: float
    world_T_own: np.ndarray  # (4, 4) float64, R and t
    how: str  # source of the alignment: PLACES or GUESS
    covariance: np.ndarray | None = None  # (7, 7) of [rotation rad, translation, logarithm of the
    # scale], each a change from the left in the new world; None = not known


def join(coarse: CoarsePoses) -> tuple[CoarsePoses, tuple[SegmentAlignment, ...]]:
    """Move the pieces of a trajectory into the world of the first, each by a guess; returns poses
    in one world, and the alignment of each further piece, in order."""
    if coarse.segments is None:
        return coarse, ()
    poses, joints = coarse.world_T_rigs.copy(), []
    for before in np.flatnonzero(np.diff(coarse.segments)).tolist():
        rows = np.flatnonzero(coarse.segments == coarse.segments[before + 1])
        move = _by_pace(before, poses, coarse.segments)
        poses[rows] = move.poses(poses[rows])
        joints.append(
            SegmentAlignment(int(rows[0]), int(rows[-1]), move.scale, move.new_T_old, GUESS)
        )
    return replace(coarse, world_T_rigs=poses), tuple(joints)


def guessed(joints: tuple[SegmentAlignment, ...], num_frames: int) -> np.ndarray:
    """True (F - 1,) for steps between two pieces whose alignment is a guess."""
    steps = np.zeros(max(num_frames - 1, 0), bool)
    steps[[joint.first - 1 for joint in joints if joint.how == GUESS]] = True
    return steps


def _by_pace(before: int, poses: np.ndarray, segments: np.ndarray) -> Sim3:
    """A similarity that continues the piece before a step at its pace with the piece behind it."""
    paces = []
    for rows in (segments == segments[before], segments == segments[before + 1]):
        lengths = np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1)
        paces.append(typical_length(lengths))
    scale = paces[0] / paces[1]
    rotation = poses[before, :3, :3] @ poses[before + 1, :3, :3].T
    alone = before == 0 or segments[before - 1] != segments[before]
    step = np.zeros(3) if alone else poses[before, :3, 3] - poses[before - 1, :3, 3]
    there = poses[before, :3, 3] + step
    return Sim3(scale, rotation, there - scale * rotation @ poses[before + 1, :3, 3])
