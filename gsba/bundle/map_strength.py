"""Strength of a map: steps that images hold well, and the trajectory's noise as these show it.

Priors on well-held steps are no help: drift is smooth, so that they all err the same way, and
together bend a place that is held a little less than others. Such steps go without one.
Covariances do not tell of frames close together with a tiny map of their own, nor of few points
that err together: steps predicted by far frames, and distances by both sides of a step, do.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from factors import bearing_residuals
from gsba.bundle.families import numbered
from gsba.bundle.trajectory_prior import StepNoise
from gsba.config import PriorSettings, RefineSettings
from gsba.geometry import (
    inverse,
    moved_to,
    pose,
    relative_steps,
    rotation_angle,
    standing_length,
    standing_places,
    step_covariances,
    typical_length,
)
from gsba.types import Counts, JointErrors, Reconstruction
from gsba.types.records import slices, spread_rows

MAX_SCALE_SIGMA = 8e-4  # relative, of two successive baselines' ratio; frames above it are weak
_WEAK_REACH = 2  # frames before and after a weak one that count as weak
_DRAWS_AT_ONCE = 50  # errors drawn of all poses, in float64
_MIN_NOISE_RATIO = 0.1  # least estimate, part of the settings' noise
_MIN_OVERLAP = 0.05  # that is expected of a step, to be judged by


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
    maps, walks = numbered(components, num), numbered(recordings, num)
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
    reach = np.ones(2 * _WEAK_REACH + 1)
    weak = np.convolve(poor, reach)[_WEAK_REACH : _WEAK_REACH + num] > 0
    lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    typical = typical_length(lengths[maps[1:] == maps[:-1]])
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
        stretches[some] = np.einsum("fi,dfi->df", steps / squares[:, None], np.diff(moved, axis=1))
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


_NEAR_FRAMES = 3  # frames to either side that do not count as far


def step_deviations(result: Reconstruction) -> np.ndarray:
    """Deviation (F - 1,) of each step from the one that far frames predict, part of the longer of
    both, and at least a tenth of the rms step; NaN = they predict none.
    """
    poses = result.world_T_rigs
    predicted, known = poses.copy(), np.zeros(len(poses), bool)
    # observations of each observation's point in frames out of reach
    frames, num = result.observation_frames.astype(np.int64), len(poses)
    first = result.observation_points.astype(np.int64) * num
    keys = np.sort(first + frames)  # by point, then frame
    last = np.searchsorted(keys, first + np.minimum(frames + _NEAR_FRAMES, num - 1), side="right")
    near = last - np.searchsorted(keys, first + np.maximum(frames - _NEAR_FRAMES, 0))
    every = np.bincount(result.observation_points)[result.observation_points]
    usable = np.flatnonzero(every - near >= 2)  # that see a point
    usable = usable[np.argsort(result.observation_frames[usable], kind="stable")]
    bounds = np.searchsorted(result.observation_frames[usable], np.arange(len(poses) + 1))
    for f in range(len(poses)):
        rows = usable[bounds[f] : bounds[f + 1]]
        known[f] = len(rows) >= 12  # of such points, in a frame
        if known[f]:
            predicted[f] = _resected(result, f, rows)
    steps = [relative_steps(some)[:, :3, 3] for some in (poses, predicted)]
    lengths = np.linalg.norm(steps, axis=2)
    least = standing_length(lengths[0])
    off = np.linalg.norm(steps[0] - steps[1], axis=1) / np.maximum(lengths.max(axis=0), least)
    return np.where(known[1:] & known[:-1], off, np.nan)


def _resected(result: Reconstruction, frame: int, rows: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a frame by its observations `rows` (O,) of points, from that in the map."""
    points = result.points_world[result.observation_points[rows]]
    bearings, sigmas = result.observation_bearings[rows], result.observation_sigmas[rows]
    origins, world_T_rig = result.observation_origins, result.world_T_rigs[frame]
    origins = None if origins is None else origins[rows]
    for _ in range(10):
        poses = np.broadcast_to(world_T_rig, (len(rows), 4, 4))
        off, by_pose, _ = bearing_residuals(poses, points, bearings, origins)
        residuals, by_pose = off / sigmas[:, None], by_pose / sigmas[:, None, None]
        weights = 1 / (1 + np.sum(residuals**2, axis=1))
        jacobian = by_pose.reshape(-1, 6)
        weighted = np.repeat(weights, 2)[:, None] * jacobian
        gradient = weighted.T @ residuals.ravel()
        step = np.linalg.lstsq(weighted.T @ jacobian, -gradient, rcond=None)[0]
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        world_T_rig = world_T_rig @ pose(turn, step[3:])
        if gradient @ -step < 1e-4:  # by which the cost falls, of squared standard deviations
            break
    return world_T_rig


def step_motion(
    before_T_rigs: np.ndarray,
    world_T_rigs: np.ndarray,
    covariances: np.ndarray,
    joint: JointErrors,
    components: np.ndarray | None = None,
) -> float:
    """Motion of the steps from frame to frame in their own standard deviations, rms: sqrt(mean(d^T
    C^-1 d) / 6) over all steps of known covariance C; NaN where there is none.

    Args:
        before_T_rigs, world_T_rigs: (F, 4, 4) poses before the round, each map in a world of any
            scale, and after it.
        covariances: (F, 6, 6) of these [rotation rad, translation], rig frames; NaN = not
            known.
        components: (F,) map of each frame, None = there is one; a step from one to another is none.
    """
    steps, former = relative_steps(world_T_rigs), relative_steps(before_T_rigs)
    maps = numbered(components, len(world_T_rigs))
    within, owners = maps[1:] == maps[:-1], maps[:-1]
    length, was = (
        np.bincount(owners, within * np.linalg.norm(some[:, :3, 3], axis=1), maps.max() + 1)
        for some in (steps, former)
    )
    former[:, :3, 3] *= (length / np.maximum(was, 1e-300))[owners, None]
    motion = inverse(former) @ steps
    tangents = np.column_stack(
        [Rotation.from_matrix(motion[:, :3, :3]).as_rotvec(), motion[:, :3, 3]]
    )
    spread = step_covariances(world_T_rigs, covariances, joint.neighbours)
    known = within & np.isfinite(spread).all(axis=(1, 2))
    if not known.any():
        return np.nan
    # Radians and map units apart by orders of magnitude: each by its own standard deviation first.
    sigmas = np.sqrt(np.maximum(np.einsum("fii->fi", spread[known]), 1e-300))
    scaled = tangents[known] / sigmas
    correlations = spread[known] / (sigmas[:, :, None] * sigmas[:, None, :])
    inverses = np.linalg.pinv(correlations, hermitian=True)
    return float(np.sqrt(np.einsum("fi,fij,fj->f", scaled, inverses, scaled).mean() / 6))


def overlap_ratios(result: Reconstruction, recordings: np.ndarray) -> np.ndarray:
    """Overlap (F - 1,) of the two places of each step over the expected one. Places: frames, or
    those in which the camera stands, which share out their points. Overlap: points that both
    observe, part of all that either does. Expected: the smaller one of both steps beside it, to the
    power of how many times as long the step is. NaN where that is hardly any, within a place, or
    where a step beside it is missing or of another one of recordings (F,)."""
    found = np.full(len(result.world_T_rigs) - 1, np.nan)
    centres = result.world_T_rigs[:, :3, 3]
    last = np.flatnonzero(np.diff(standing_places(centres)))  # frame before each step
    frames = np.split(np.arange(len(centres)), last + 1)  # of each place
    observed = result.observations_by_frame()
    points = [
        np.unique(result.observation_points[np.concatenate([observed[f] for f in place])])
        for place in frames
    ]
    common = [len(np.intersect1d(*two, assume_unique=True)) for two in pairwise(points)]
    each = np.array([len(some) for some in points])
    overlaps = common / np.maximum(each[:-1] + each[1:] - common, 1)
    lengths = np.linalg.norm(centres[last + 1] - centres[last], axis=1)
    for step in range(1, len(last) - 1):
        beside = [step - 1, step + 1]
        times = max(lengths[step] / max(lengths[beside].max(), 1e-300), 1.0)
        expected = overlaps[beside].min() ** times
        around = recordings[np.concatenate(frames[step - 1 : step + 3])]
        if len(set(around.tolist())) == 1 and expected > _MIN_OVERLAP:
            found[last[step]] = overlaps[step] / expected
    return found


_MIN_POINTS = 8  # that both sides see
_SIGMAS = 2.0  # standard errors of the median that count as uncertainty


def scale_changes(result: Reconstruction, recordings: np.ndarray) -> np.ndarray:
    """Largest relative change (F - 1,) of scale that may hide at each step: the median difference
    of distances by both sides, and two standard errors of it by their scatter. inf = too few points
    are seen by both sides; NaN = a side is at one place, of recordings (F,)."""
    found = np.full(max(len(result.world_T_rigs) - 1, 0), np.nan)
    observed = result.observations_by_frame()
    for step, first, end in _sides(result.world_T_rigs[:, :3, 3], recordings):
        before = np.concatenate(observed[first : step + 1])
        behind = np.concatenate(observed[step + 1 : end])
        middle = result.world_T_rigs[step : step + 2, :3, 3].mean(axis=0)
        found[step] = _change(result, before, behind, middle)
    return found


def _sides(positions: np.ndarray, recordings: np.ndarray) -> Iterator[tuple[int, int, int]]:
    """Steps with two places and more on both sides: step, first before, end behind."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    least = standing_length(steps)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    reach = 6.0 * typical_length(steps) * (1 + 1e-9)  # a side is six usual steps long
    for step in range(len(steps)):
        own = np.flatnonzero(recordings == recordings[step])
        first = max(int(np.searchsorted(along, along[step] - reach)), int(own[0]))
        end = min(
            int(np.searchsorted(along, along[step + 1] + reach, side="right")), int(own[-1]) + 1
        )
        if recordings[step] == recordings[step + 1] and all(
            np.ptp(positions[side], axis=0).max(initial=0.0) > least
            for side in (slice(first, step + 1), slice(step + 1, end))
        ):
            yield step, first, end


def _change(
    result: Reconstruction, before: np.ndarray, behind: np.ndarray, middle: np.ndarray
) -> float:
    """Change of scale that may hide between two sides' observations; distances from `middle`."""
    several = []
    for rows in (before, behind):
        names, counts = np.unique(result.observation_points[rows], return_counts=True)
        several.append(names[counts > 1])
    common = np.intersect1d(*several, assume_unique=True)
    if len(common) < _MIN_POINTS:
        return np.inf
    ends, spreads = zip(
        *(_triangulated(result, rows, common) for rows in (before, behind)), strict=True
    )
    mean = (ends[0] + ends[1]) / 2 - middle
    lengths = np.maximum(np.linalg.norm(mean, axis=1), 1e-12)
    towards = mean / lengths[:, None]
    distances = [np.einsum("ni,ni->n", end - middle, towards) for end in ends]
    known = np.ones(len(common), bool)
    for distance, spread in zip(distances, spreads, strict=True):
        variances = np.einsum("ni,nij,nj->n", towards, spread, towards)
        known &= (distance > 0) & (variances < (0.1 * lengths) ** 2)
    if np.count_nonzero(known) < _MIN_POINTS:
        return np.inf
    logs = np.log(distances[1][known] / distances[0][known])
    median = float(np.median(logs))
    # standard deviation of normal values
    scatter = 1.4826 * float(np.median(np.abs(logs - median)))
    # 1.2533: standard error of a median of normal values, over that of their mean
    return abs(median) + _SIGMAS * 1.2533 * scatter / np.sqrt(len(logs))


def _triangulated(
    result: Reconstruction, rows: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) of points (N,) by some observations alone, and covariances; NaN if parallel."""
    index = np.searchsorted(points, result.observation_points[rows])
    index[index == len(points)] = 0
    own = points[index] == result.observation_points[rows]
    rows, index = rows[own], index[own]
    frames, origins = result.world_T_rigs[result.observation_frames[rows]], None
    if result.observation_origins is not None:
        origins = result.observation_origins[rows]
    placed = moved_to(frames, origins)[:, :3, 3]
    rays = np.einsum("oij,oj->oi", frames[:, :3, :3], result.observation_bearings[rows])
    depths = np.linalg.norm(result.points_world[points[index]] - placed, axis=1)
    weights = 1 / (np.maximum(depths, 1e-12) * result.observation_sigmas[rows]) ** 2
    off = placed - np.einsum("oi,oi->o", rays, placed)[:, None] * rays
    (x, y, z), (a, b, c) = rays.T, (weights[:, None] * off).T
    upper = weights * np.stack([1 - x * x, -x * y, -x * z, 1 - y * y, -y * z, 1 - z * z])
    sums = np.stack([np.bincount(index, row, len(points)) for row in (*upper, a, b, c)], axis=1)
    systems = sums[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    lowest, _, highest = np.linalg.eigvalsh(systems).T
    parallel = lowest <= 1e-9 * highest
    systems[parallel] = np.eye(3)
    covariances = np.linalg.inv(systems)
    places = np.einsum("nij,nj->ni", covariances, sums[:, 6:])
    covariances[parallel] = np.nan
    return places, covariances
