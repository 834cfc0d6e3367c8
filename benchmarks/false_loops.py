"""Synthetic false loop closures between different places, like those of identical bays."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
from scipy.spatial import cKDTree  # type: ignore[attr-defined]

from gsba.geometry import inverse
from gsba.matching import correspondences
from gsba.matching.guided_search import MatchContext
from gsba.types import Counts, Matches, Solution, VerifiedPairs

MAX_DEG = 0.5  # between a keypoint and the other frame's point projected by the false pose


def forge(context: MatchContext, solved: Solution, pairs: list[tuple[int, int]]) -> VerifiedPairs:
    """Verified matches of frames that share no part of the scene.

    The second frame of a pair gets the pose of the first one's successor. Its matches are the
    keypoints near map points projected by that pose.
    """
    known = solved.points_by_keypoint(context.keypoints)
    rows, poses = [], []
    for f0, f1 in pairs:
        f0_T_f1 = inverse(solved.world_T_rigs[f0]) @ solved.world_T_rigs[f0 + 1]
        mine = np.flatnonzero(np.isfinite(known[f0]).all(axis=1))
        seen = (known[f0][mine] - f0_T_f1[:3, 3]) @ f0_T_f1[:3, :3]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        away, theirs = cKDTree(context.keypoints.bearings_of(f1)).query(seen)
        _, first = np.unique(theirs, return_index=True)
        first = first[away[first] < np.radians(MAX_DEG)]
        rows.append(np.column_stack([mine[first], theirs[first]]).astype(np.int32))
        f0_T_f1[:3, 3] /= np.linalg.norm(f0_T_f1[:3, 3])
        poses.append(f0_T_f1)
    matches = Matches.of_rows(np.array(pairs, np.int32), rows)
    counts = Counts(len(pairs), len(pairs), "pairs")
    return VerifiedPairs(matches, np.array(poses), np.zeros(len(pairs)), counts)


@contextmanager
def forged_loops(first: int, far: int, count: int) -> Iterator[list[int]]:
    """Add `count` false loop closures to runs in this context, of frames `first` + n and n + `far`.

    Yields:
        number of matches of each false pair, filled when a run has closed its loops.
    """
    honest, sizes = correspondences.match_loops, []

    def match_loops(context: MatchContext, solved: Solution) -> VerifiedPairs:
        found = honest(context, solved)
        pairs = [(first + n, first + n + far) for n in range(count)]
        false = forge(context, solved, pairs)
        sizes[:] = np.diff(false.matches.offsets).tolist()
        ours, theirs = found.matches, false.matches
        both = Matches(
            np.concatenate([ours.pairs, theirs.pairs]),
            np.concatenate([ours.offsets, ours.offsets[-1] + theirs.offsets[1:]]),
            np.concatenate([ours.keypoints, theirs.keypoints]),
        )
        poses = np.concatenate([found.f0_T_f1s, false.f0_T_f1s])
        sigmas = np.concatenate([found.direction_sigmas, false.direction_sigmas])
        return VerifiedPairs(both, poses, sigmas, found.counts)

    with patch.object(correspondences, "match_loops", match_loops):
        yield sizes
