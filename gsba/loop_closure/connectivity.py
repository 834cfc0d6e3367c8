"""Which frames belong together: tied by images or steps, and the matches and maps of each group."""

from dataclasses import replace

import numpy as np

from gsba.bundle.adjustment import Adjustment
from gsba.types import FrameSet, Matches, Reconstruction


def parted(
    pairs: np.ndarray, held: np.ndarray, scarce: np.ndarray | None = None
) -> np.ndarray | None:
    """Part (F,) int64 that each frame is in, 0 that of the most frames; None = there is one.

    Args:
        pairs: (P, 2) frames that images tie together.
        held: (F - 1,) bool, steps that tie their frames besides.
        scarce: (F,) bool, frames that are parts of their own whatever the pairs.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    num, steps = len(held) + 1, np.flatnonzero(held)
    rows, columns = np.concatenate([pairs.reshape(-1, 2), np.column_stack([steps, steps + 1])]).T
    if scarce is not None:
        fed = ~(scarce[rows] | scarce[columns])
        rows, columns = rows[fed], columns[fed]
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(num, num))
    return several(by_size(connected_components(graph, directed=False)[1]))


def several(found: np.ndarray) -> np.ndarray | None:
    """Labels, or None where all are the same."""
    return found if (found != found[0]).any() else None


def by_size(found: np.ndarray) -> np.ndarray:
    """Labels (F,) numbered anew, the most frequent one 0."""
    _, first, inverse_, counts = np.unique(
        found, return_index=True, return_inverse=True, return_counts=True
    )
    ranks = np.empty(len(counts), np.int64)
    ranks[np.lexsort((first, -counts))] = np.arange(len(counts))
    return ranks[inverse_]


def within(matches: Matches, parts: np.ndarray | None) -> Matches:
    """Matches of pairs whose frames are in one part (F,); None = there is one."""
    if parts is None:
        return matches
    keep = np.flatnonzero(parts[matches.pairs[:, 0]] == parts[matches.pairs[:, 1]])
    if len(keep) == len(matches.pairs):
        return matches
    rows = [matches.of(int(p)) for p in keep]
    none = np.zeros((0, 2), np.int32)
    return Matches(
        matches.pairs[keep], np.cumsum([0, *map(len, rows)]), np.concatenate([none, *rows])
    )


def starving(solved: Adjustment, least: int) -> np.ndarray:
    """Frames (F,) bool with fewer than `least` observations of a map."""
    seen = np.bincount(solved.landmarks.tracks.frames, minlength=len(solved.world_T_rigs))
    return seen < least


def largest(reconstruction: Reconstruction) -> np.ndarray:
    """Frames (F',) int64 of the largest map: those that are exported."""
    if reconstruction.components is None:
        return np.arange(len(reconstruction.world_T_rigs))
    return np.flatnonzero(reconstruction.components == 0)


def taken(
    reconstruction: Reconstruction, frames: FrameSet, rows: np.ndarray
) -> tuple[Reconstruction, FrameSet]:
    """What some frames (F',), ascending, hold of a result: their poses, points and images."""
    if len(rows) == len(frames):
        return reconstruction, frames
    number = np.full(len(frames), -1)
    number[rows] = np.arange(len(rows))
    seen = number[reconstruction.observation_frames] >= 0
    points, which = np.unique(reconstruction.observation_points[seen], return_inverse=True)
    joint = reconstruction.joint_errors
    part = replace(
        reconstruction,
        world_T_rigs=reconstruction.world_T_rigs[rows],
        pose_covariances=reconstruction.pose_covariances[rows],
        pose_statuses=reconstruction.pose_statuses[rows],
        points_world=reconstruction.points_world[points],
        point_colors=reconstruction.point_colors[points],
        point_errors=reconstruction.point_errors[points],
        observation_points=which.astype(np.int32),
        observation_frames=number[reconstruction.observation_frames[seen]].astype(np.int32),
        observation_bearings=reconstruction.observation_bearings[seen],
        observation_sigmas=reconstruction.observation_sigmas[seen],
        components=None,
        joint_errors=joint and joint.taken(rows),
    )
    kept = replace(
        frames,
        names=tuple(frames.names[f] for f in rows),
        paths=tuple(frames.paths[f] for f in rows),
        timestamps=frames.timestamps[rows],
        mask_paths=tuple(frames.mask_paths[f] for f in rows),
    )
    return part, kept
