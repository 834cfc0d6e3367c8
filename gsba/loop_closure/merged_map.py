"""A map whose parts were joined, and the consequences for the trajectory and its report."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import extent_of
from gsba.similarity import Sim3
from gsba.trajectory.joining import PLACES, SegmentAlignment
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, Counts, PoseSource, Solution


@dataclass(frozen=True, slots=True)
class Registered:
    """A map whose parts were joined where they overlap."""

    solved: Solution  # each map in the world of its earliest part
    components: np.ndarray  # (F,) int32, map of each frame, 0 = the largest
    scales: np.ndarray  # (F,) float64: each frame was moved by scale * R @ x + t
    moves: np.ndarray  # (F, 4, 4) float64, R and t
    offsets: np.ndarray  # (F, 3) float64, added so that maps lie side by side
    met: np.ndarray  # (F,) bool: images connect it to the map's first part
    alone: np.ndarray  # (F,) bool: its pose comes from points of the map
    lost: np.ndarray  # (F,) bool: no pose could be found
    counts: Counts  # of parts
    reasons: tuple[str, ...] = ()  # (maps) why each map, by its component, was not joined to a
    # larger one, as text for the report; "" or missing = unknown

    def move(self, f: int) -> Sim3:
        """The similarity by which a frame was moved, before its map was laid beside others."""
        return Sim3.of(float(self.scales[f]), self.moves[f])


def carried(
    solved: Solution,
    world_T_rigs: np.ndarray,
    scales: np.ndarray,
    moves: np.ndarray,
    offsets: np.ndarray,
) -> Solution:
    """A map with poses (F, 4, 4) after moves, see `Registered`; points move with first frames."""
    landmarks = solved.landmarks.moved(scales, moves)
    points = landmarks.points_world + offsets[landmarks.tracks.hosts()]
    landmarks = replace(landmarks, points_world=points)
    return replace(solved, world_T_rigs=world_T_rigs, landmarks=landmarks)


def laid_out(positions: np.ndarray, components: np.ndarray, reach: float) -> np.ndarray:
    """Offsets (F, 3) to positions (F, 3) by which maps (F,) lie apart: no frame is within `reach`,
    map units, of a point of another."""
    offsets = np.zeros((len(components), 3))
    groups = [components == c for c in range(int(components.max()) + 1)]
    extent = max(extent_of(positions[group]) for group in groups)
    for number, group in enumerate(groups[1:], 1):
        # maps lie four of their extents apart
        away = np.array([number * 4.0 * (extent + reach), 0, 0])
        offsets[group] = positions[groups[0]].mean(axis=0) + away
        offsets[group] -= positions[group].mean(axis=0)
    return offsets


def follow(
    registered: Registered,
    coarse: CoarsePoses,
    trust: StepChecks,
    joints: tuple[SegmentAlignment, ...],
) -> tuple[CoarsePoses, StepChecks, tuple[SegmentAlignment, ...]]:
    """The trajectory, its checks and its alignments after parts of the map were moved.

    Steps without matches lose their prior if images connect both their frames to one map. A piece
    of the trajectory whose pose was a guess moves with its frames.
    """
    together = registered.components[:-1] == registered.components[1:]
    met = registered.met[:-1] & registered.met[1:] & together
    false = trust.false_steps | (trust.unseen_steps & met) | ~together
    placed = registered.solved.world_T_rigs.copy()
    trust = replace(trust, world_T_rigs=placed.copy(), false_steps=false)
    placed[:, :3, 3] -= registered.offsets
    if coarse.absent:
        return replace(coarse, world_T_rigs=placed), trust, joints
    unguided = (coarse.sources == PoseSource.NONE)[:, None, None]  # have the poses of the map
    poses, followed = coarse.world_T_rigs.copy(), []
    in_main = registered.met & ~registered.alone & (registered.components == 0)
    for joint in joints:
        rows = np.arange(joint.first, joint.last + 1)
        known = rows[in_main[rows]]
        if len(known) and np.count_nonzero(in_main) > len(known):
            move = registered.move(int(known[0]))
            poses[rows] = move.poses(poses[rows])
            own = move.after(Sim3.of(joint.scale, joint.world_T_own))
            joint = replace(joint, scale=own.scale, world_T_own=own.new_T_old, how=PLACES)
        followed.append(joint)
    poses = np.where(unguided, placed, poses)
    return replace(coarse, world_T_rigs=poses), trust, tuple(followed)
