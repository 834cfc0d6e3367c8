"""Pieces of a trajectory, each with an origin and a scale of its own, brought into one world.

Where the images show the steps over a break, the chain of their relative poses, with lengths in
proportion, is laid over the frames before it and over those behind: what lies between both is the
similarity of the pieces. Where they show nothing, the piece is placed by guess: it goes on at the
same pace.
"""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import rotation_angle
from gsba.similarity import Sim3
from gsba.trajectory.steps import Steps, chained
from gsba.types import CoarsePoses, PoseSource

_REACH = 8  # frames of the trajectory on either side of a break
_FURTHEST = 40  # frames looked through for them
IMAGES, PLACES, GUESS = "images over the break", "places met again", "guess: the same pace"


@dataclass(frozen=True, slots=True)
class Joint:
    """How a piece of the trajectory lies in the world of the first: x = scale * R @ own + t."""

    first: int  # its first frame
    last: int  # its last frame
    scale: float
    world_T_own: np.ndarray  # (4, 4) float64, R and t
    how: str


def join(
    coarse: CoarsePoses, found: Steps, logs: np.ndarray, sigmas: np.ndarray
) -> tuple[CoarsePoses, tuple[Joint, ...]]:
    """Carry the pieces of a trajectory into the world of the first.

    Args:
        coarse: poses of each piece in its own world.
        found: steps from the images.
        logs, sigmas: ratios of their lengths, see `gsba.trajectory.steps.length_ratios`.

    Returns:
        Poses in one world, and how each further piece was joined, in order.
    """
    if coarse.segments is None:
        return coarse, ()
    poses, joints = coarse.world_T_rigs.copy(), []
    own = coarse.sources == PoseSource.SLAM
    for before in np.flatnonzero(np.diff(coarse.segments)).tolist():
        rows = np.flatnonzero(coarse.segments == coarse.segments[before + 1])
        shown = _over(before, poses, coarse.segments, own, found, logs, sigmas)
        move, how = shown or _by_pace(before, poses, coarse.segments), IMAGES if shown else GUESS
        poses[rows] = move.poses(poses[rows])
        joints.append(Joint(int(rows[0]), int(rows[-1]), move.scale, move.new_T_old, how))
    return replace(coarse, world_T_rigs=poses), tuple(joints)


def guessed(joints: tuple[Joint, ...], num_frames: int) -> np.ndarray:
    """Steps (F - 1,) bool over which no image says how two pieces lie."""
    steps = np.zeros(max(num_frames - 1, 0), bool)
    steps[[joint.first - 1 for joint in joints if joint.how == GUESS]] = True
    return steps


def _over(
    before: int,
    poses: np.ndarray,
    segments: np.ndarray,
    own: np.ndarray,
    found: Steps,
    logs: np.ndarray,
    sigmas: np.ndarray,
) -> Sim3 | None:
    """Similarity of the piece behind a step to that before it, by the images around the step."""
    if not found.directed[before]:
        return None
    first, last, lengths = before, before, {before: 0.0}
    while first > 0 and found.directed[first - 1] and np.isfinite(sigmas[first - 1]):
        if segments[first - 1] != segments[before] or _enough(own[first : before + 1]):
            break
        lengths[first - 1] = lengths[first] - logs[first - 1]
        first -= 1
    while last + 1 < len(found.directed) and found.directed[last + 1] and np.isfinite(sigmas[last]):
        if segments[last + 2] != segments[before + 1] or _enough(own[before + 1 : last + 2]):
            break
        lengths[last + 1] = lengths[last] + logs[last]
        last += 1
    steps = found.f_T_nexts[first : last + 1].copy()
    steps[:, :3, 3] *= np.exp([lengths[s] for s in range(first, last + 1)])[:, None]
    chain, frames = chained(steps), np.arange(first, last + 2)
    sides = []
    for side in (frames <= before, frames > before):
        used = side & own[frames]
        laid = _laid(chain[used], poses[frames[used]], frames[used])
        if laid is None:
            return None
        sides.append(laid)
    before_break, behind = sides
    scale, rotation = before_break.scale / behind.scale, before_break.rotation @ behind.rotation.T
    return Sim3(scale, rotation, before_break.translation - scale * rotation @ behind.translation)


def _enough(own: np.ndarray) -> bool:
    return int(np.count_nonzero(own)) >= _REACH or len(own) >= _FURTHEST


def _laid(chain: np.ndarray, poses: np.ndarray, frames: np.ndarray) -> Sim3 | None:
    """What lays a chain over poses (N, 4, 4) of it.

    Medians, so that a false pose among them does not count.
    """
    beside = np.diff(frames) == 1
    theirs = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)[beside]
    ours = np.linalg.norm(np.diff(chain[:, :3, 3], axis=0), axis=1)[beside]
    if len(ours) == 0 or not (theirs > 0).all():
        return None
    scale = float(np.median(theirs / ours))
    turns = poses[:, :3, :3] @ np.swapaxes(chain[:, :3, :3], 1, 2)
    apart = rotation_angle(np.swapaxes(turns, 1, 2)[:, None] @ turns[None])
    rotation = turns[np.argmin(np.median(apart, axis=1))]
    shifts = poses[:, :3, 3] - scale * chain[:, :3, 3] @ rotation.T
    return Sim3(scale, rotation, np.median(shifts, axis=0))


def _by_pace(before: int, poses: np.ndarray, segments: np.ndarray) -> Sim3:
    """A similarity after which the piece behind a step goes on where that before it ends."""
    paces = []
    for rows in (segments == segments[before], segments == segments[before + 1]):
        lengths = np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1)
        paces.append(float(np.median(lengths)) if (lengths > 0).any() else 1.0)
    scale = paces[0] / paces[1] if min(paces) > 0 else 1.0
    rotation = poses[before, :3, :3] @ poses[before + 1, :3, :3].T
    alone = before == 0 or segments[before - 1] != segments[before]
    step = np.zeros(3) if alone else poses[before, :3, 3] - poses[before - 1, :3, 3]
    there = poses[before, :3, 3] + step
    return Sim3(scale, rotation, there - scale * rotation @ poses[before + 1, :3, 3])
