"""Uncertainty of points: by their observations, the poses given, and by errors of the poses."""

import numpy as np

from factors import tangent_basis
from gsba.geometry import extent_of, moved_to
from gsba.significance import MEDIAN_ABS_NORMAL
from gsba.types import Reconstruction

_TRACKS_PER_CLASS, _MAX_CLASSES = 100, 10  # classes of points by the noise of their observations
_MIN_TRACK_LENGTH = 3  # of two observations, only those across the baseline that agree are kept
_MIN_SHARE = 1e-3  # least part of a shift across the baseline that no move of the point explains


def point_covariances(result: Reconstruction) -> np.ndarray:
    """Covariances (J, 3, 3) of points by their observations, the poses given, map units^2."""
    poses, num = result.world_T_rigs, len(result.points_world)
    positions = poses[:, :3, 3]
    extent = max(extent_of(positions), 1e-12)
    # before any observation, a point is known to ten extents of the map
    informations = np.tile(np.eye(3) / (10.0 * extent) ** 2, (num, 1, 1))
    for some in result.pieces():
        np.add.at(informations, some.observation_points, _informations(some))
    return np.linalg.inv(informations)


def depth_variances(result: Reconstruction, axes: np.ndarray) -> np.ndarray:
    """Variances (O,) of the depths of observed points from their frames, map units^2, along axes
    (O, 3) float64, unit, world; without joint errors, the result's poses count as given.

    Poses in error move all points that they see: the depth of a point errs by how far its own shift
    differs from that of the frame. An error in the scale of all poses and points is no error here.
    Errors of one point's observations are not independent, see `_error_ratios`.
    """
    covariances, poses = point_covariances(result), result.world_T_rigs
    turns, moves, scales = _pose_errors(result)
    # Errors of depths, in units of what shifts across the baseline predict: 1.7 to 1.9 in four maps
    # of two rendered scenes, on surfaces that are flat for two pixels around. Shifts along the
    # baseline are larger, and slant turns errors across the ray into errors of depth (1.25 of it).
    ratios = np.square(1.8 * _error_ratios(result, covariances))
    variances, start = np.empty(len(axes)), 0
    for some in result.pieces():
        points, frames = some.observation_points, some.observation_frames
        rows = slice(start, start := start + len(points))
        _, firsts, numbers = np.unique(points, return_index=True, return_inverse=True)
        reaches = some.points_world[points] - poses[frames, :3, 3]
        depths, information = np.sum(axes[rows] * reaches, axis=1), _informations(some)
        variance = np.einsum("oi,oij,oj->o", axes[rows], covariances[points], axes[rows])
        variance *= ratios[points]
        for turn, move, scale in zip(turns, moves, scales, strict=True):
            shifts = move[frames] + np.cross(turn[frames], reaches)  # of what the frame sees there
            pulls = np.einsum("oij,oj->oi", information, shifts)
            pulls = np.add.reduceat(pulls, firsts, axis=0) if len(points) else pulls
            moved = np.einsum("oij,oj->oi", covariances[points], pulls[numbers])
            errors = np.sum(axes[rows] * (moved - shifts), axis=1) - scale * depths
            variance += np.square(errors) / len(turns)
        variances[rows] = variance
    return variances


def _error_ratios(result: Reconstruction, covariances: np.ndarray) -> np.ndarray:
    """True errors of points (J,) in units of those that independent observations would have.

    A patch that is seen from elsewhere shows other surfaces beside its own, and its foreshortening
    is known roughly: its shift grows with the change of the viewing direction, as that of a wrong
    depth does. The depth absorbs the shift along the baseline; the one across it remains in the
    residuals, and is as large as predicted if errors are independent.
    """
    shifts = _shifts_across(result, covariances)
    num = np.bincount(result.observation_points, minlength=len(shifts))
    squares = np.bincount(result.observation_points, result.observation_sigmas**2, len(shifts))
    noise = squares / np.maximum(num, 1)
    usable = np.isfinite(shifts) & (num >= _MIN_TRACK_LENGTH)
    classes = min(int(np.count_nonzero(usable)) // _TRACKS_PER_CLASS, _MAX_CLASSES)
    if classes == 0:
        return np.ones(len(shifts))
    bounds = np.unique(np.quantile(noise[usable], np.arange(1, classes) / classes))
    bounds = bounds[bounds < noise[usable].max()]
    which, ratios = np.searchsorted(bounds, noise), np.empty(len(bounds) + 1)
    for number in range(len(ratios)):
        ratios[number] = np.median(np.abs(shifts[usable & (which == number)])) / MEDIAN_ABS_NORMAL
    return ratios[which]


def _shifts_across(result: Reconstruction, covariances: np.ndarray) -> np.ndarray:
    """Shifts (J,) across the track of observations' errors, in independent ones' sigmas; or NaN."""
    num = len(covariances)
    axes = np.linalg.eigh(covariances)[1][:, :, 2]  # the least certain ones
    slopes, pulls, sums = np.zeros((num, 3)), np.zeros((num, 3)), np.zeros((2, num))
    for some in result.pieces():
        points, lenses = some.observation_points, _lens_poses(some)
        reaches = some.points_world[points] - lenses[:, :3, 3]
        distances = np.maximum(np.linalg.norm(reaches, axis=1), 1e-12)
        rays = np.einsum("oij,oj->oi", lenses[:, :3, :3], some.observation_bearings)
        scales = (some.observation_sigmas * distances)[:, None]
        across = np.cross(rays, axes[points]) / scales
        residuals = reaches / scales - rays / some.observation_sigmas[:, None]
        residuals -= np.sum(residuals * rays, axis=1, keepdims=True) * rays
        np.add.at(slopes, points, across / scales)
        np.add.at(pulls, points, residuals / scales)
        sums[0] += np.bincount(points, np.sum(across**2, axis=1), num)
        sums[1] += np.bincount(points, np.sum(across * residuals, axis=1), num)
    moved = np.einsum("jik,jk->ji", covariances, slopes)
    information = sums[0] - np.sum(moved * slopes, axis=1)
    determined = information > _MIN_SHARE * sums[0]
    shifts = (sums[1] - np.sum(moved * pulls, axis=1)) / np.sqrt(np.maximum(information, 1e-300))
    return np.where(determined, shifts, np.nan)


def _lens_poses(some: Reconstruction) -> np.ndarray:
    """Poses (O, 4, 4) world_T_lens of observations."""
    return moved_to(some.world_T_rigs[some.observation_frames], some.observation_origins)


def _informations(some: Reconstruction) -> np.ndarray:
    """Information (O, 3, 3) of observations on their points, in the world, 1/map unit^2."""
    points, lenses = some.observation_points, _lens_poses(some)
    distances = np.linalg.norm(some.points_world[points] - lenses[:, :3, 3], axis=1)
    scales = some.observation_sigmas * np.maximum(distances, 1e-12)
    axes = tangent_basis(some.observation_bearings) / scales[:, None, None]
    axes = axes @ np.swapaxes(lenses[:, :3, :3], 1, 2)
    return np.swapaxes(axes, 1, 2) @ axes


def _pose_errors(result: Reconstruction) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Turns and moves (D, F, 3) of pose errors drawn, in the world, and relative scales (D,)."""
    if result.joint_errors is None:
        return np.zeros((0, 0, 3)), np.zeros((0, 0, 3)), np.zeros(0)
    # standard deviations of 16 draws are right within a fifth
    draws = np.nan_to_num(result.joint_errors.draws[:16].astype(float))
    world_R_rigs = result.world_T_rigs[:, :3, :3]
    turns = np.einsum("fij,dfj->dfi", world_R_rigs, draws[..., :3])
    moves = np.einsum("fij,dfj->dfi", world_R_rigs, draws[..., 3:])
    around = result.world_T_rigs[:, :3, 3] - result.world_T_rigs[:, :3, 3].mean(axis=0)
    scales = np.einsum("fi,dfi->d", around, moves) / max(float(np.sum(around**2)), 1e-300)
    return turns, moves, scales
