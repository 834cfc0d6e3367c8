"""Strength of a map: steps that images hold well, and the trajectory's noise as these show it.

Priors on well-held steps are no help: drift is smooth, so that they all err the same way, and
together bend a place that is held a little less than others. Such steps go without one.
"""

from dataclasses import dataclass

import numpy as np

from gsba.config import PriorSettings, RefineSettings
from gsba.geometry import inverse, rotation_angle, step_covariances
from gsba.types import Counts, JointErrors, Reconstruction, StepNoise
from gsba.types.records import slices, spread_rows

MAX_SCALE_SIGMA = 8e-4  # relative, of two successive baselines' ratio; frames above it are weak
_REACH = 2  # frames before and after a weak one that count as weak
_DRAWS_AT_ONCE = 50  # errors drawn of all poses, in float64
_MIN_NOISE_RATIO = 0.1  # least estimate, part of the settings' noise


@dataclass(frozen=True, slots=True)
class MapStrength:
    """Uncertainty of a map by its images alone."""

    scale_sigmas: np.ndarray  # (F - 2,) float64, of the logarithm of a step's length over that of
    # the step before it, at the frame between them; NaN = not known
    drift: np.ndarray  # (C,) float64, rms error of positions to be expected of each map after the
    # best similarity, part of the path of its longest recording
    weak: np.ndarray  # (F,) bool, frames at or near places where the scale is uncertain, in maps
    # that drift
    held_steps: np.ndarray  # (F - 1,) bool, steps whose covariance is far below the trajectory's
    noise: StepNoise | None  # of the trajectory's steps; None = too few steps are held to estimate
    # it
    counts: Counts  # of priors on the trajectory's steps
    contradiction: float = 0.0  # of GPS fixes by the images, see `gps_factors.contradiction`


def measure(
    world_T_rigs: np.ndarray,
    errors: tuple[np.ndarray, JointErrors],
    coarse_world_T_rigs: np.ndarray,
    seen: np.ndarray,
    believed: np.ndarray,
    settings: RefineSettings,
    components: np.ndarray | None = None,
    recordings: np.ndarray | None = None,
) -> MapStrength:
    """Judge a solution by the joint covariance of its poses under negligible priors.

    Args:
        world_T_rigs, coarse_world_T_rigs: (F, 4, 4) poses, and those of the trajectory.
        errors: covariances (F, 6, 6) [rotation rad, translation], rig frames, and what errors
            of poses have in common.
        seen, believed: (F - 1,) bool, steps that images show, and those of the trajectory that
            they do not contradict.
        components, recordings: (F,) map and recording of each frame, from 0; None = there is
            one.
    """
    covariances, joint = errors
    num, weak_frames, priors = len(world_T_rigs), settings.weak_frames, settings.priors
    maps = np.zeros(num, np.int32) if components is None else components
    walks = np.zeros(num, np.int64) if recordings is None else recordings
    drift = np.array(
        [
            _drift(world_T_rigs[maps == m], joint.draws[:, maps == m], walks[maps == m])
            for m in range(maps.max() + 1)
        ]
    )
    drifting = drift[maps] > weak_frames.max_drift
    sigmas = scale_sigmas(world_T_rigs, joint.draws)
    between = seen[:-1] & seen[1:] & np.isfinite(sigmas)
    poor = np.zeros(num, bool)
    poor[1:-1] = drifting[1:-1] & between & (np.nan_to_num(sigmas) > MAX_SCALE_SIGMA)
    reach = np.ones(2 * _REACH + 1)
    weak = np.convolve(poor, reach)[_REACH : _REACH + num] > 0
    lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    typical = float(np.median(lengths[lengths > 0])) if (lengths > 0).any() else 1.0
    allowed = np.full((len(lengths), 6), np.deg2rad(priors.rotation_deg))
    allowed[:, 3:] = priors.translation * np.maximum(lengths, typical)[:, None]
    found = step_covariances(world_T_rigs, covariances, joint.neighbours)
    found = found / allowed[:, :, None] / allowed[:, None, :]
    known = np.isfinite(found).all(axis=(1, 2))
    found[~known] = np.eye(6)
    # a quarter of the prior's sigma in every direction: it then weighs 6 %
    held = seen & known & (np.linalg.eigvalsh(found)[:, -1] < 0.25**2)
    noise = _noise(world_T_rigs, coarse_world_T_rigs, held & believed, priors)
    num_held = int(held.sum())
    dropped = {"images hold the step far better": num_held}
    counts = Counts(num - 1, num - 1 - num_held, "priors on steps", dropped)
    return MapStrength(sigmas, drift, weak, held, noise, counts)


def scale_sigmas(world_T_rigs: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """See `MapStrength.scale_sigmas`; to first order in the errors `draws (D, F, 6)`."""
    steps = np.diff(world_T_rigs[:, :3, 3], axis=0)
    squares = np.maximum(np.einsum("fi,fi->f", steps, steps), 1e-300)
    stretches = np.empty((len(draws), len(steps)))
    for some in slices(len(draws), _DRAWS_AT_ONCE):
        moved = np.einsum("fij,dfj->dfi", world_T_rigs[:, :3, :3], draws[some, :, 3:])
        along = np.einsum("fi,dfi->df", steps / squares[:, None], np.diff(moved, axis=1))
        stretches[some] = along
    return np.diff(stretches, axis=1).std(axis=0)


def position_errors(world_T_rigs: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Errors of positions (D, F) to be expected after the best similarity, map units, to first
    order in the errors `draws (D, F, 6)`; NaN = not known, of all frames if fewer than three are.
    """
    found = np.full(draws.shape[:2], np.nan)
    known = np.isfinite(draws).all(axis=(0, 2))
    if np.count_nonzero(known) < 3:
        return found
    poses = world_T_rigs[known]
    offsets = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    turns = [np.cross(axis, offsets) for axis in np.eye(3)]
    shifts = [np.tile(axis, (len(poses), 1)) for axis in np.eye(3)]
    basis = np.linalg.qr(np.array([*shifts, *turns, offsets]).reshape(7, -1).T)[0]
    for some in slices(len(draws), _DRAWS_AT_ONCE):
        errors = np.einsum("fij,dfj->dfi", poses[:, :3, :3], draws[some][:, known, 3:])
        flat = errors.reshape(-1, 3 * len(poses))
        errors = (flat - flat @ basis @ basis.T).reshape(errors.shape)
        found[some, known] = np.linalg.norm(errors, axis=2)
    return found


def neighbour_shifts(result: Reconstruction) -> np.ndarray:
    """Angles (F,) in radians, rms, by which points of a frame are to be expected beside their
    pictures in the next one, by errors of the step between both; NaN = not known, as of the last.
    """
    poses, joint = result.world_T_rigs, result.joint_errors
    found = np.full(len(poses), np.nan)
    if joint is None:
        return found
    for f, seen in enumerate(result.observations_by_frame()[:-1]):
        if not len(seen):
            continue
        rows = seen[spread_rows(len(seen), min(len(seen), 24))]
        points, moved = result.points_world[result.observation_points[rows]], []
        for frame in (f, f + 1):
            at_rig = (points - poses[frame, :3, 3]) @ poses[frame, :3, :3]
            errors = joint.draws[:, frame, None].astype(np.float64)
            moved.append(np.cross(errors[..., :3], at_rig) + errors[..., 3:])
        turn = poses[f, :3, :3].T @ poses[f + 1, :3, :3]
        depths = np.linalg.norm(at_rig, axis=1)[:, None]
        rays = at_rig / depths
        shifts = (moved[0] @ turn - moved[1]) / depths
        across = shifts - np.sum(shifts * rays, axis=2, keepdims=True) * rays
        found[f] = np.sqrt(np.median(np.mean(np.sum(across**2, axis=2), axis=0)))
    return found


def _drift(world_T_rigs: np.ndarray, draws: np.ndarray, walks: np.ndarray) -> float:
    """See `MapStrength.drift`; 0 where fewer than three poses are known."""
    errors = position_errors(world_T_rigs, draws)
    known = np.isfinite(errors).all(axis=0)
    if not known.any():
        return 0.0
    lengths = np.linalg.norm(np.diff(world_T_rigs[known, :3, 3], axis=0), axis=1)
    within = np.diff(walks[known]) == 0  # from one recording to the next is no step
    path = np.bincount(walks[known][1:][within], lengths[within]).max(initial=0.0)
    return float(np.sqrt(np.mean(errors[:, known] ** 2)) / max(path, 1e-300))


def _noise(
    world_T_rigs: np.ndarray, coarse: np.ndarray, held: np.ndarray, priors: PriorSettings
) -> StepNoise | None:
    """Robust spread of the trajectory's steps about those that the images hold."""
    if np.count_nonzero(held) < 8:
        return None
    found, given = (inverse(some[:-1])[held] @ some[1:][held] for some in (world_T_rigs, coarse))
    turned = rotation_angle(np.swapaxes(given[:, :3, :3], 1, 2) @ found[:, :3, :3])
    moves = found[:, :3, 3], given[:, :3, 3]
    across = np.linalg.norm(np.cross(*moves), axis=1)
    off = np.arctan2(across, np.einsum("fi,fi->f", *moves))
    logs = np.diff([np.log(np.maximum(np.linalg.norm(m, axis=1), 1e-12)) for m in moves], axis=0)[0]
    medians = np.median(turned), np.median(off), np.median(np.abs(logs - np.median(logs)))
    spreads = np.array(medians) / (1.5382, 1.1774, 0.6745)  # of normal errors in 3, 2 and 1 axes
    least = np.array([np.deg2rad(priors.rotation_deg), priors.translation, priors.translation])
    return StepNoise(*np.maximum(spreads, _MIN_NOISE_RATIO * least).tolist())
