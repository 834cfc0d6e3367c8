"""Uncertainty of points: by their observations, the poses given, and by errors of the poses."""

import numpy as np

from factors import tangent_basis
from gsba.geometry import moved_to
from gsba.types import Reconstruction

_PRIOR_EXTENTS = 10.0  # standard deviation of a point before any observation, extents of the map
_MAX_DRAWS = 16  # of the poses' errors: standard deviations of 16 are right within a fifth


def point_covariances(result: Reconstruction) -> np.ndarray:
    """Covariances (J, 3, 3) of points by their observations, the poses given, map units^2."""
    poses, num = result.world_T_rigs, len(result.points_world)
    positions = poses[:, :3, 3]
    extent = max(float(np.linalg.norm(np.ptp(positions, axis=0))), 1e-12)
    informations = np.tile(np.eye(3) / (_PRIOR_EXTENTS * extent) ** 2, (num, 1, 1))
    for some in result.pieces():
        np.add.at(informations, some.observation_points, _informations(some))
    return np.linalg.inv(informations)


def depth_variances(result: Reconstruction, axes: np.ndarray) -> np.ndarray:
    """Variances (O,) of the depths of observed points from their frames, map units^2.

    Poses in error move all points that they see: the depth of a point errs by how far its own shift
    differs from that of the frame. An error in the scale of all poses and points is no error here.

    Args:
        result: with the poses' joint errors; without them, poses count as given.
        axes: (O, 3) float64, unit, world: direction in which each depth is measured.
    """
    covariances, poses = point_covariances(result), result.world_T_rigs
    turns, moves, scales = _pose_errors(result)
    variances, start = np.empty(len(axes)), 0
    for some in result.pieces():
        points, frames = some.observation_points, some.observation_frames
        rows = slice(start, start := start + len(points))
        _, firsts, numbers = np.unique(points, return_index=True, return_inverse=True)
        reaches = some.points_world[points] - poses[frames, :3, 3]
        depths, information = np.sum(axes[rows] * reaches, axis=1), _informations(some)
        variance = np.einsum("oi,oij,oj->o", axes[rows], covariances[points], axes[rows])
        for turn, move, scale in zip(turns, moves, scales, strict=True):
            shifts = move[frames] + np.cross(turn[frames], reaches)  # of what the frame sees there
            pulls = np.einsum("oij,oj->oi", information, shifts)
            pulls = np.add.reduceat(pulls, firsts, axis=0) if len(points) else pulls
            moved = np.einsum("oij,oj->oi", covariances[points], pulls[numbers])
            errors = np.sum(axes[rows] * (moved - shifts), axis=1) - scale * depths
            variance += np.square(errors) / len(turns)
        variances[rows] = variance
    return variances


def _informations(some: Reconstruction) -> np.ndarray:
    """Information (O, 3, 3) of observations on their points, in the world, 1/map unit^2."""
    points, poses = some.observation_points, some.world_T_rigs
    lenses = moved_to(poses[some.observation_frames], some.observation_origins)
    distances = np.linalg.norm(some.points_world[points] - lenses[:, :3, 3], axis=1)
    scales = some.observation_sigmas * np.maximum(distances, 1e-12)
    axes = tangent_basis(some.observation_bearings) / scales[:, None, None]
    axes = axes @ np.swapaxes(lenses[:, :3, :3], 1, 2)
    return np.swapaxes(axes, 1, 2) @ axes


def _pose_errors(result: Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations and translations (D, F, 3) of draws of the poses' errors, in the world, and the
    relative error (D,) of the scale of each draw; D = 0: they are unknown."""
    if result.joint_errors is None:
        return np.zeros((0, 0, 3)), np.zeros((0, 0, 3)), np.zeros(0)
    draws = np.nan_to_num(result.joint_errors.draws[:_MAX_DRAWS].astype(float))
    world_R_rigs = result.world_T_rigs[:, :3, :3]
    turns = np.einsum("fij,dfj->dfi", world_R_rigs, draws[..., :3])
    moves = np.einsum("fij,dfj->dfi", world_R_rigs, draws[..., 3:])
    around = result.world_T_rigs[:, :3, 3] - result.world_T_rigs[:, :3, 3].mean(axis=0)
    scales = np.einsum("fi,dfi->d", around, moves) / max(float(np.sum(around**2)), 1e-300)
    return turns, moves, scales
