"""From poses to correspondences: neighbours in time, closed loops, and the map itself."""

import numpy as np

from gsba import matching, pairs, verify
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.geometry import inverse
from gsba.matching import Gate, SearchableFrames
from gsba.types import Keypoints, Matches, VerifiedPairs


def match_neighbours(
    frames: SearchableFrames,
    strongest: SearchableFrames,
    keypoints: Keypoints,
    start: Adjustment,
    settings: RefineSettings,
    num_threads: int,
) -> VerifiedPairs:
    """Match frames next to one another in time, guided by the trajectory, and verify them.

    Args:
        frames, keypoints: features of all frames.
        strongest: the same frames with the strongest keypoints only.
        start: the coarse poses.
        settings: of matching and verification.
        num_threads: pairs matched at a time.
    """
    world_T_rigs = start.world_T_rigs
    chosen = pairs.adjacent(len(world_T_rigs))
    prior = settings.pairs.prior
    gate = _gate(prior.rotation_deg, prior.direction, settings)

    def match(among: SearchableFrames, pairs_: np.ndarray) -> Matches:
        gates = [gate] * len(pairs_)
        return matching.run(pairs_, world_T_rigs, gates, among, settings.matching, num_threads)

    # The strongest keypoints are enough to find a pair's geometry, at a tenth of the cost.
    found = match(strongest, chosen)
    scarce = np.flatnonzero(np.diff(found.offsets) < settings.pairs.scarce_matches)
    if len(scarce):
        found = _replaced(found, scarce, match(frames, chosen[scarce]))
    f0_T_f1s = inverse(world_T_rigs[chosen[:, 0]]) @ world_T_rigs[chosen[:, 1]]
    exact = np.zeros(len(chosen))
    return verify.run(
        found, keypoints, f0_T_f1s, exact, settings.verify, settings.seed, num_threads
    )


def match_loops(
    frames: SearchableFrames,
    keypoints: Keypoints,
    solved: Adjustment,
    settings: RefineSettings,
    num_threads: int,
) -> VerifiedPairs:
    """Match frames close in space but far in time, as far as drift leaves them predictable.

    Only known points are looked for, as far around their predicted bearing as drift can have moved
    them. What repeats at a distance, arches or columns, is further off than that.

    Args:
        frames, keypoints: features of all frames.
        solved: poses and points that are right between neighbours.
        settings: of pairs, matching and verification.
        num_threads: pairs matched at a time.
    """
    world_T_rigs, positions = solved.world_T_rigs, solved.world_T_rigs[:, :3, 3]
    depth = median_depth(solved)
    chosen = pairs.covisible(positions, depth, settings.pairs)[1]
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = np.concatenate([[0], np.cumsum(steps)])
    drifts = settings.pairs.drift * (along[chosen[:, 1]] - along[chosen[:, 0]])
    gates = [
        _point_gate(np.deg2rad(settings.pairs.loop_deg) + 2 * drift / max(depth, 1e-12))
        for drift in drifts
    ]
    known = points_by_keypoint(solved, keypoints)
    found = matching.run(chosen, world_T_rigs, gates, frames, settings.matching, num_threads, known)
    f0_T_f1s = inverse(world_T_rigs[chosen[:, 0]]) @ world_T_rigs[chosen[:, 1]]
    return verify.run(
        found, keypoints, f0_T_f1s, drifts, settings.verify, settings.seed, num_threads
    )


def match_along_epipolars(
    frames: SearchableFrames, solved: Adjustment, settings: RefineSettings, num_threads: int
) -> Matches:
    """Match neighbours in time again, along the epipolar lines of poses that are nearly right.

    Args:
        frames: features of all frames.
        solved: the current solution.
        settings: of pairs and matching.
        num_threads: pairs matched at a time.
    """
    chosen, refined = pairs.adjacent(len(solved.world_T_rigs)), settings.pairs.refined
    gates = [_gate(refined.rotation_deg, refined.direction, settings)] * len(chosen)
    poses = solved.world_T_rigs
    return matching.run(chosen, poses, gates, frames, settings.matching, num_threads)


def match_known_points(
    frames: SearchableFrames,
    keypoints: Keypoints,
    solved: Adjustment,
    settings: RefineSettings,
    num_threads: int,
    loops_closed: bool,
) -> Matches:
    """Match frames further apart only where a known point must appear.

    Prediction is the verification: what merely looks alike elsewhere, a column further on, is not
    a candidate.

    Args:
        frames, keypoints: features of all frames.
        solved: the current solution.
        settings: of pairs and matching.
        num_threads: pairs matched at a time.
        loops_closed: whether frames far apart in time are predictable too.
    """
    poses = solved.world_T_rigs
    near, loops = pairs.covisible(poses[:, :3, 3], median_depth(solved), settings.pairs)
    chosen = near[near[:, 1] - near[:, 0] > 2]
    if loops_closed:
        chosen = np.concatenate([chosen, loops])
    gates = [_point_gate(np.deg2rad(settings.pairs.point_deg))] * len(chosen)
    known = points_by_keypoint(solved, keypoints)
    search = matching.guided  # where a point is known this well, no network knows better
    return matching.run(chosen, poses, gates, frames, settings.matching, num_threads, known, search)


def median_depth(solved: Adjustment) -> float:
    """Median distance of points from the frames that see them, map units; 0 without points."""
    tracks, points = solved.landmarks.tracks, solved.landmarks.points_world
    offsets = points[tracks.points] - solved.world_T_rigs[tracks.frames, :3, 3]
    return float(np.median(np.linalg.norm(offsets, axis=1))) if len(offsets) else 0.0


def points_by_keypoint(solved: Adjustment, keypoints: Keypoints) -> list[np.ndarray]:
    """For each frame (K_f, 3): its keypoints' points in its rig frame, NaN where unknown."""
    tracks = solved.landmarks.tracks
    known = np.full((len(keypoints.faces), 3), np.nan)
    world_T_rig = solved.world_T_rigs[tracks.frames]
    offsets = solved.landmarks.points_world[tracks.points] - world_T_rig[:, :3, 3]
    known[keypoints.rows(tracks)] = np.einsum("oji,oj->oi", world_T_rig[:, :3, :3], offsets)
    return np.split(known, keypoints.starts[1:-1])


def _replaced(matches: Matches, indices: np.ndarray, others: Matches) -> Matches:
    """Matches with those of some pairs exchanged."""
    rows = [matches.of(p) for p in range(len(matches.pairs))]
    for n, p in enumerate(indices):
        rows[p] = others.of(n)
    return Matches(matches.pairs, np.cumsum([0, *map(len, rows)]), np.concatenate(rows))


def _point_gate(radius_rad: float) -> Gate:
    """A gate around predicted points only."""
    return Gate(np.pi, 1.0, np.pi, min(radius_rad, np.pi))


def _gate(rotation_deg: float, direction: float, settings: RefineSettings) -> Gate:
    return Gate(np.deg2rad(rotation_deg), direction, np.deg2rad(settings.pairs.max_parallax_deg))
