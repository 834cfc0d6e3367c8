"""Proof that a camera only turned: most matches of a pair agree on one rotation, in which chance
has no part, and so do most matches of all pairs one, two, four and eight frames apart. That no
translation is found would prove nothing."""

from dataclasses import dataclass

import numpy as np

from gsba.camera.rig import witnesses
from gsba.geometry import nearest_rotation
from gsba.significance import log10_false_alarms, outweighs
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import Keypoints, VerifiedPairs

CELLS_PER_SIDE = 16  # cells along a face's side: all matches within one, 6 degrees, count as one
# witness
MAX_PARALLAX_RAD = np.deg2rad(1.0)  # largest angle between the bearings of a match that a rotation
# explains: 5 cm of a hand or of two lenses, seen from 3 m; no depth follows from less
MAX_HAND_PARALLAX_RAD = np.deg2rad(3.0)  # the same where images determine no positions: 12 cm
# between two frames of a hand, seen from 2.3 m
_SAMPLE_SIZE = 2  # matches that determine a rotation
_MIN_FRAMES = 3  # least frames of a turn, unless there are only two


@dataclass(frozen=True, slots=True)
class Turn:
    """Frames of a camera that only turned, and their rotations."""

    frames: np.ndarray  # (F,) bool, tied together by pairs that a rotation explains
    world_R_rigs: np.ndarray  # (F, 3, 3) float64, world of the first of these frames; of other
    # frames, the rotation of the frame before


def rotation_of_most(rays0: np.ndarray, rays1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """f0_R_f1 (3, 3) that best rotates most unit rays (m, 3) of frame 1 onto those of frame 0, and
    the distances (m,) that it leaves, radians."""
    near, rotation, off = np.ones(len(rays0), bool), np.eye(3), np.zeros(len(rays0))
    for _ in range(5):
        rotation = nearest_rotation(rays0[near].T @ rays1[near])
        off = np.linalg.norm(rays0 - rays1 @ rotation.T, axis=1)
        near = off <= np.median(off)
    return rotation, off


def prove(
    pairs: VerifiedPairs,
    keypoints: Keypoints,
    settings: TwoViewLimits,
    max_parallax: float = MAX_PARALLAX_RAD,
) -> Turn | None:
    """The largest part of the frames that turned on the spot, by pairs, the closest first; None =
    not proved. A rotation explains bearings up to `max_parallax` radians apart."""
    frames, num_frames = pairs.matches.pairs, len(keypoints.starts) - 1
    rotations, counts = np.empty((len(frames), 3, 3)), np.empty((len(frames), 2), int)
    for p, pair in enumerate(frames):
        rays = keypoints.matched(pair, pairs.matches.of(p))
        rotations[p], off = rotation_of_most(*rays)
        alike = off < max_parallax
        counts[p] = [witnesses(rays[0][some], CELLS_PER_SIDE) for some in (alike, ~alike)]
    chance = max_parallax / np.pi  # a false match lies anywhere along its epipolar line
    proved = np.zeros(len(frames), bool)
    for p, (support, against) in enumerate(counts.tolist()):
        # Matches surely agree on a rotation, and no translation explains as many more.
        alarms = log10_false_alarms(support + against, support, chance, _SAMPLE_SIZE)
        significant = alarms < np.log10(settings.max_false_alarms)
        proved[p] = significant and outweighs(support, against, settings.max_error_rate)
    turn = _tied(frames[proved], rotations[proved], num_frames)
    if np.count_nonzero(turn.frames) < min(_MIN_FRAMES, num_frames):
        return None
    inside, gaps = turn.frames[frames].all(axis=1), np.diff(frames, axis=1)[:, 0]
    for gap in np.unique(gaps[inside]):
        support, against = counts[inside & (gaps == gap)].sum(axis=0).tolist()
        if not outweighs(support, against, settings.max_error_rate):
            return None
    return turn


def _tied(pairs: np.ndarray, rotations: np.ndarray, num_frames: int) -> Turn:
    """The largest part that pairs (P, 2) tie together, rotations chained along the closest ones."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import (
        breadth_first_order,
        connected_components,
        minimum_spanning_tree,
    )

    gaps, shape = np.diff(pairs, axis=1)[:, 0], (num_frames, num_frames)
    graph = coo_matrix((gaps, pairs.T), shape=shape).tocsr()
    labels = connected_components(graph, directed=False)[1]
    tied = labels == np.argmax(np.bincount(labels))
    first, numbers = int(np.argmax(tied)), {tuple(pair): p for p, pair in enumerate(pairs.tolist())}
    order, before = breadth_first_order(minimum_spanning_tree(graph), first, directed=False)
    world_R_rigs = np.tile(np.eye(3), (num_frames, 1, 1))
    for f, other in zip(order[1:].tolist(), before[order[1:]].tolist(), strict=True):
        p = numbers.get((other, f))
        turn = rotations[numbers[(f, other)]].T if p is None else rotations[p]
        world_R_rigs[f] = world_R_rigs[other] @ turn
    for f in np.flatnonzero(~tied[1:]) + 1:
        world_R_rigs[f] = world_R_rigs[f - 1]
    return Turn(tied, world_R_rigs)
