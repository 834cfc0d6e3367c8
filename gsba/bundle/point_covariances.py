"""Covariances of points by their observations, the poses given."""

import numpy as np

from factors import tangent_basis
from gsba.geometry import moved_to
from gsba.types import Reconstruction

_PRIOR_EXTENTS = 10.0  # standard deviation of a point before any observation, extents of the map


def point_covariances(result: Reconstruction) -> np.ndarray:
    """Covariances (J, 3, 3) of points by their observations, the poses given, map units^2."""
    poses, num = result.world_T_rigs, len(result.points_world)
    positions = poses[:, :3, 3]
    extent = max(float(np.linalg.norm(np.ptp(positions, axis=0))), 1e-12)
    informations = np.tile(np.eye(3) / (_PRIOR_EXTENTS * extent) ** 2, (num, 1, 1))
    for some in result.pieces():
        points = some.observation_points
        lenses = moved_to(poses[some.observation_frames], some.observation_origins)
        distances = np.linalg.norm(some.points_world[points] - lenses[:, :3, 3], axis=1)
        scales = some.observation_sigmas * np.maximum(distances, 1e-12)
        axes = tangent_basis(some.observation_bearings) / scales[:, None, None]
        axes = axes @ np.swapaxes(lenses[:, :3, :3], 1, 2)
        np.add.at(informations, points, np.swapaxes(axes, 1, 2) @ axes)
    return np.linalg.inv(informations)
