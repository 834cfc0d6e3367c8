"""The result of a run, in the world and scale of the coarse trajectory."""

import numpy as np

from gsba.adjust import Adjustment
from gsba.geometry import angular_errors, pose, pose_similarity
from gsba.types import CoarsePoses, Keypoints, PoseSource, PoseStatus, Reconstruction


def assemble(
    adjustment: Adjustment,
    covariances: np.ndarray,
    keypoints: Keypoints,
    coarse: CoarsePoses,
    min_observations: int,
    false_frames: np.ndarray | None = None,
    correction: tuple[float, ...] = (),
) -> Reconstruction:
    """Carry the solution back to the trajectory's world and gather what exports need.

    Args:
        adjustment: the last solution.
        covariances: (F, 6, 6) of its poses.
        keypoints: of all frames.
        coarse: poses that define the world; interpolated ones have no say in it.
        min_observations: frames with fewer count as unrefined.
        false_frames: (F,) bool, frames whose coarse pose has no say either.
        correction: of the frames, which the keypoints have.
    """
    world_T_rigs, landmarks = adjustment.world_T_rigs, adjustment.landmarks
    seen = np.bincount(landmarks.tracks.frames, minlength=len(world_T_rigs))
    refined = seen >= min_observations
    known = refined & (coarse.sources == PoseSource.SLAM)
    if false_frames is not None:
        known &= ~false_frames
    known = known if np.count_nonzero(known) > 1 else np.ones(len(known), bool)
    scale, rotation, translation = pose_similarity(world_T_rigs[known], coarse.world_T_rigs[known])
    placed = pose(
        rotation @ world_T_rigs[:, :3, :3],
        scale * world_T_rigs[:, :3, 3] @ rotation.T + translation,
    )
    stretch = np.array([1, 1, 1, scale, scale, scale])
    rows = keypoints.rows(landmarks.tracks)
    points = landmarks.tracks.points
    lengths = np.bincount(points, minlength=len(landmarks.points_world))
    bearings = keypoints.bearings_rig[rows]
    poses = world_T_rigs[landmarks.tracks.frames]
    errors = angular_errors(poses, landmarks.points_world[points], bearings)
    colors = np.column_stack(
        [
            np.bincount(points, keypoints.colors[rows, channel], len(lengths)) / lengths
            for channel in range(3)
        ]
    )
    return Reconstruction(
        placed,
        covariances * stretch[:, None] * stretch,
        np.where(refined, PoseStatus.REFINED, PoseStatus.UNREFINED).astype(np.uint8),
        scale * landmarks.points_world @ rotation.T + translation,
        np.rint(colors).astype(np.uint8),
        np.bincount(points, errors, len(lengths)) / lengths,
        points,
        landmarks.tracks.frames,
        bearings,
        adjustment.noise * keypoints.sigmas_rad[rows],
        correction,
    )
