"""The result of a run, in the world and scale of the coarse trajectory."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsba.bundle.families import numbered
from gsba.bundle.tracks import runs
from gsba.disk import concatenated
from gsba.geometry import angular_errors, furthest, moved_to
from gsba.log import GsbaError
from gsba.memory import release_mapped_files
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity
from gsba.types import (
    CoarsePoses,
    JointErrors,
    Keypoints,
    PoseSource,
    PoseStatus,
    Reconstruction,
    Solution,
    Tracks,
)
from gsba.types.records import AT_ONCE

MIN_OBSERVATIONS = 12  # of a refined frame: 24 residuals for the 6 unknowns of its pose
_MIN_PLACED = 3  # frames of a stretch that places a map: two always correlate
_MIN_CORRELATION = 0.1  # least correlation of refined and coarse positions: with usual drift it is
# .8


def assemble(
    adjustment: Solution,
    covariances: np.ndarray,
    keypoints: Keypoints,
    coarse: CoarsePoses | None,
    min_observations: int,
    false_frames: np.ndarray | None = None,
    components: np.ndarray | None = None,
    joint_errors: JointErrors | None = None,
    scratch: Path | None = None,
    false_steps: np.ndarray | None = None,
) -> Reconstruction:
    """Carry the solution back to the trajectory's world and gather what exports need.

    Args:
        covariances: (F, 6, 6) of its poses.
        coarse: poses that define the world, unless they are interpolated; None = world and scale
            of the solution are those of the result.
        min_observations: frames with fewer count as unrefined.
        false_frames: (F,) bool, frames whose coarse pose has no say either.
        components: (F,) map of each frame, each carried to its own coarse poses; None = one map.
        joint_errors: of the poses; None = not known.
        scratch: folder on the disk that takes arrays of all observations; None = they are in
            memory.
        false_steps: (F - 1,) bool, coarse steps that images contradict. Where the frames of a map
            do not lie as their coarse poses, its longest stretch without such a step places it.

    Raises:
        GsbaError: not where the trajectory has its frames, or residuals that no solution leaves.
    """
    landmarks, seen = adjustment.landmarks, adjustment.observations()
    refined = seen >= min_observations
    known = refined if false_frames is None else refined & ~false_frames
    targets = None
    if coarse is not None:
        known, targets = known & (coarse.sources == PoseSource.SLAM), coarse.world_T_rigs
    groups = numbered(components, len(seen))
    false = np.zeros(max(len(seen) - 1, 0), bool) if false_steps is None else false_steps
    placed, points_world, stretch = _placed(adjustment, targets, known, groups, false)
    scales = stretch[np.unique(groups, return_index=True)[1], 3]  # of each map
    points = landmarks.tracks.points
    lengths = np.maximum(np.bincount(points, minlength=len(landmarks.points_world)), 1)
    colors = np.zeros((len(lengths), 3), np.uint8)
    pieces = _observations(adjustment, keypoints, stretch[:, 3], colors)
    bearings, sigmas, errors, *origins = concatenated(pieces, scratch)
    median = float(np.degrees(np.median(errors))) if len(errors) else 0.0
    if not median <= 10.0:  # largest median residual: gates leave a tenth of a degree
        raise GsbaError(
            f"the solution fell apart (median residual {median:.1f} deg): nothing is written; "
            "check that frames and trajectory belong together, or refine without it "
            "(--no-trajectory)"
        )
    return Reconstruction(
        placed,
        covariances * stretch[:, :, None] * stretch[:, None, :],
        np.where(refined, PoseStatus.REFINED, PoseStatus.UNREFINED).astype(np.uint8),
        points_world,
        colors,
        np.bincount(points, errors, len(lengths)) / lengths,
        points,
        landmarks.tracks.frames,
        bearings,
        sigmas,
        components=components,
        joint_errors=joint_errors and joint_errors.scaled(stretch),
        observation_origins=origins[0] if origins else None,
        map_scales=None if components is None else scales / scales[0],
    )


def _observations(
    adjustment: Solution, keypoints: Keypoints, scales: np.ndarray, colors: np.ndarray
) -> Iterator[tuple[np.ndarray, ...]]:
    """Bearings (O, 3), sigmas and angles (O,) to points, radians, origins; of some at a time."""
    landmarks, poses = adjustment.landmarks, adjustment.world_T_rigs
    nothing, none = np.empty((0, 3)), np.empty(0)
    yield (nothing, none, none, *([] if keypoints.origins_rig is None else [nothing]))
    for points, _, some in runs(landmarks.tracks, AT_ONCE):
        rows = keypoints.rows(some)
        bearings, origins = keypoints.bearings_rig[rows], keypoints.origins_of(rows)
        ends = landmarks.points_world[points][some.points]
        errors = angular_errors(moved_to(poses[some.frames], origins), ends, bearings)
        colors[points] = mean_colors(some, keypoints)
        moved = [] if origins is None else [scales[some.frames][:, None] * origins]
        yield (bearings, adjustment.noise * keypoints.sigmas_rad[rows], errors, *moved)
        release_mapped_files()


def mean_colors(tracks: Tracks, keypoints: Keypoints) -> np.ndarray:
    """Mean colours (J, 3) uint8, RGB, of the keypoints of each track."""
    lengths = np.maximum(np.bincount(tracks.points, minlength=tracks.num_points), 1)
    channels = keypoints.colors[keypoints.rows(tracks)].T
    sums = [np.bincount(tracks.points, one, tracks.num_points) for one in channels]
    return np.rint(np.column_stack(sums) / lengths[:, None]).astype(np.uint8)


def world_scale(solved: Solution, result: Reconstruction) -> float:
    """Unit of a solution in the world of the result that was assembled from it."""
    rows = result.largest_map()
    lengths = [furthest(T[rows, :3, 3])[1] for T in (solved.world_T_rigs, result.world_T_rigs)]
    return lengths[1] / lengths[0] if lengths[0] > 0 else 1.0


def _placed(
    adjustment: Solution,
    target_T_rigs: np.ndarray | None,
    known: np.ndarray,
    groups: np.ndarray,
    false_steps: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses, points, and factors (F, 6) of standard deviations, each map in its own world.

    Frames `known` (F,) say where their map goes; all do, where fewer than two are. If these do not
    lie as their coarse poses, at no scale, those of the longest stretch without `false_steps`
    (F - 1,) do: tracking that was lost may go on in another world. Of `groups` (F,) a map but the
    largest that does not lie as its stretch either stays as solved.
    """
    poses, landmarks = adjustment.world_T_rigs, adjustment.landmarks
    placed, stretch = np.empty_like(poses), np.ones((len(poses), 6))
    points, hosts = np.empty_like(landmarks.points_world), landmarks.tracks.hosts()
    if target_T_rigs is None:
        return poses, landmarks.points_world, stretch
    stretches = np.concatenate([[0], np.cumsum(false_steps)])
    for group in np.unique(groups):
        inside = groups == group
        chosen = known & inside if np.count_nonzero(known & inside) > 1 else inside
        longest = chosen & (stretches == np.bincount(stretches[chosen]).argmax())
        try:
            move = _move(poses, target_T_rigs, chosen, longest)
        except NoSimilarityError as error:
            if group == 0:
                raise GsbaError(
                    f"the {np.count_nonzero(chosen)} frames that could place the result do not "
                    f"lie as the trajectory has them ({error}): check its times and --fps, or "
                    "refine without it (--no-trajectory)"
                ) from None
            move = Sim3()
        placed[inside] = move.poses(poses[inside])
        stretch[inside, 3:] = move.scale
        there = inside[hosts]
        points[there] = move.points(landmarks.points_world[there])
    return placed, points, stretch


def _move(
    poses: np.ndarray, target_T_rigs: np.ndarray, chosen: np.ndarray, fewer: np.ndarray
) -> Sim3:
    """Similarity of poses (F, 4, 4) to their targets by the frames `chosen` (F,) bool, or by
    `fewer` of them if these do not lie as their targets. NoSimilarityError if neither do."""
    try:
        return pose_similarity(poses[chosen], target_T_rigs[chosen], _MIN_CORRELATION)
    except NoSimilarityError:
        if not _MIN_PLACED <= np.count_nonzero(fewer) < np.count_nonzero(chosen):
            raise
        return pose_similarity(poses[fewer], target_T_rigs[fewer], _MIN_CORRELATION)
