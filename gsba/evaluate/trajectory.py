"""Errors of a trajectory against the truth: ATE, rotation, relative pose errors, all-pairs AUC."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from gsba.geometry import extent_of, nearest_rotation, quaternion_from_rotation, rotation_angle
from gsba.log import GsbaError
from gsba.similarity import Sim3, residuals_of, similarity
from gsba.trajectory.association import matched_in_time
from gsba.types import Trajectory

AUC_THRESHOLDS_DEG = (0.1, 0.25, 0.5, 1.0, 5.0, 10.0)
TOLERANCE_S = 0.01  # largest difference of the times of a pose and its true one, seconds
_PAIRS_AT_ONCE = 1 << 18


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Summary of one error over all its samples; NaN if there are none."""

    rmse: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: np.ndarray) -> "ErrorStatistics":
        """Statistics of (N,) non-negative errors."""
        if len(errors) == 0:
            return cls(np.nan, np.nan, np.nan)
        rmse = float(np.sqrt(np.mean(np.square(errors))))
        return cls(rmse, float(np.median(errors)), float(np.max(errors)))


@dataclass(frozen=True, slots=True)
class TrajectoryErrors:
    """Errors of a trajectory against the truth."""

    num_truth: int  # number of true poses
    num_matched: int  # number of these with an estimate; every pair with one of the others fails
    scale: float  # truth units per estimate unit, of the Sim(3) alignment
    ate: ErrorStatistics  # truth units, positions after Sim(3) alignment
    rotation_deg: ErrorStatistics  # degrees, after the best common rotation
    rpe_translation: ErrorStatistics  # truth units, consecutive poses, estimate times scale
    rpe_rotation_deg: ErrorStatistics  # degrees, consecutive poses ("relative rotation error")
    auc: Mapping[float, float]  # threshold in degrees -> area under the recall curve, 0..1

    def to_json(self) -> dict:
        """Plain dict for json.dump; AUC thresholds become strings, NaN becomes None."""
        out = asdict(self)
        for name in ("ate", "rotation_deg", "rpe_translation", "rpe_rotation_deg"):
            out[name] = {k: v if np.isfinite(v) else None for k, v in out[name].items()}
        out["auc"] = {f"{threshold:g}": area for threshold, area in self.auc.items()}
        return out


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of each pose of a trajectory, after alignment to the truth."""

    rows: np.ndarray  # (M,) int, rows of the estimate
    true_rows: np.ndarray  # (M,) int, rows of the truth, ascending
    fit: Sim3  # from the estimate's world into the truth's, by positions
    positions: np.ndarray  # (M,) float64, truth units
    rotations: np.ndarray  # (M,) float64, radians, after the best common rotation


def pose_errors(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float = TOLERANCE_S
) -> PoseErrors:
    """Errors of single poses; for alignment, arguments and exceptions see `evaluate`."""
    rows_e, rows_t = matched_in_time(estimate, truth, tolerance_s)
    if len(rows_t) < 3:
        raise GsbaError(
            f"only {len(rows_t)} of {len(truth.timestamps)} true poses have an estimate within "
            f"{tolerance_s:g} s; alignment needs 3: check that both use one clock"
        )
    world_T_rigs, true_T_rigs = estimate.world_T_rigs[rows_e], truth.world_T_rigs[rows_t]
    rotations, true_rotations = world_T_rigs[:, :3, :3], true_T_rigs[:, :3, :3]
    positions, true_positions = world_T_rigs[:, :3, 3], true_T_rigs[:, :3, 3]
    for owner, points in (("estimate", positions), ("truth", true_positions)):
        if np.ptp(points, axis=0).max() <= 1e-12 * (1 + np.abs(points).max()):
            raise GsbaError(f"the {owner} does not move: its positions determine no scale")
    fit = similarity(positions, true_positions)
    common = nearest_rotation((true_rotations @ np.swapaxes(rotations, 1, 2)).sum(axis=0))
    residual = np.swapaxes(true_rotations, 1, 2) @ common @ rotations
    off = residuals_of(fit, positions, true_positions)
    return PoseErrors(rows_e, rows_t, fit, off, rotation_angle(residual))


def evaluate(
    estimate: Trajectory, truth: Trajectory, tolerance_s: float = TOLERANCE_S
) -> TrajectoryErrors:
    """Compare a trajectory of any world and scale with the truth.

    Poses are associated by time: mutually nearest and within the tolerance. Positions are aligned
    by the least-squares similarity, orientations by their own best rotation: the positions of a
    straight path do not determine its roll.

    Args:
        estimate: estimated poses; non-finite ones count as missing.
        truth: the true poses; each one without an estimate counts as missing.
        tolerance_s: largest difference of timestamps, seconds.

    Raises:
        GsbaError: fewer than three poses match in time, or their positions coincide.
    """
    errors = pose_errors(estimate, truth, tolerance_s)
    rows_t, scale = errors.true_rows, errors.fit.scale
    world_T_rigs, true_T_rigs = estimate.world_T_rigs[errors.rows], truth.world_T_rigs[rows_t]
    steps = np.flatnonzero(np.diff(rows_t) == 1)
    step_translation, step_rotation = _step_errors(world_T_rigs, true_T_rigs, steps, scale)
    pair_errors = np.degrees(_pair_errors(world_T_rigs, true_T_rigs))
    num_truth = len(truth.timestamps)
    return TrajectoryErrors(
        num_truth=num_truth,
        num_matched=len(rows_t),
        scale=scale,
        ate=ErrorStatistics.of(errors.positions),
        rotation_deg=ErrorStatistics.of(np.degrees(errors.rotations)),
        rpe_translation=ErrorStatistics.of(step_translation),
        rpe_rotation_deg=ErrorStatistics.of(np.degrees(step_rotation)),
        auc=area_under_recall(pair_errors, num_truth * (num_truth - 1) // 2, AUC_THRESHOLDS_DEG),
    )


def area_under_recall(
    errors: np.ndarray, num_expected: int, thresholds: Sequence[float]
) -> dict[float, float]:
    """Area under the recall curve up to each threshold, divided by the threshold.

    Recall is the piecewise-linear curve through (0, 0) and (error of rank r, r / num_expected),
    constant from the last error under the threshold on; integrated exactly. This is the AUC of
    the relative-pose literature (Sarlin et al., SuperGlue, CVPR 2020).

    Args:
        errors: (P,) errors, P <= num_expected; missing ones count as infinite.
        num_expected: number of expected errors.
        thresholds: thresholds in the unit of the errors, positive.

    Returns:
        threshold -> area, 0..1.
    """
    ordered = np.sort(errors[errors < max(thresholds)])
    areas = {}
    for threshold in thresholds:
        below = ordered[: np.searchsorted(ordered, threshold)]
        recall = np.arange(len(below) + 1) / num_expected
        x = np.concatenate([[0.0], below, [threshold]])
        y = np.append(recall, recall[-1])
        areas[threshold] = float(np.trapezoid(y, x) / threshold)
    return areas


def format_table(
    rows: Mapping[str, TrajectoryErrors],
    extra: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """Text table with a line per trajectory, units under the column names.

    Args:
        rows: name -> errors.
        extra: further columns, header with unit -> cells of all rows.
    """
    header = [
        ["", "poses", "ATE rmse", "median", "max", "rotation", "rel. rot.", "RPE"]
        + [f"AUC@{threshold:g}°" for threshold in AUC_THRESHOLDS_DEG],
        ["", "", "units", "units", "units", "deg", "deg", "units"]
        + ["%"] * len(AUC_THRESHOLDS_DEG),
    ]
    lines = header + [
        [name, f"{e.num_matched}/{e.num_truth}"]
        + [f"{value:.4f}" for value in (e.ate.rmse, e.ate.median, e.ate.max)]
        + [f"{e.rotation_deg.median:.3f}", f"{e.rpe_rotation_deg.median:.4f}"]
        + [f"{e.rpe_translation.median:.5f}"]
        + [f"{100 * e.auc[threshold]:.1f}" for threshold in AUC_THRESHOLDS_DEG]
        for name, e in rows.items()
    ]
    for title, cells in (extra or {}).items():
        for line, cell in zip(lines, [title, "", *cells], strict=True):
            line.append(cell)
    note = "rotation, rel. rot. (consecutive poses) and RPE are medians; ATE after Sim(3)."
    return "\n".join([*aligned_rows(lines), note])


def aligned_rows(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
        for row in rows
    ]


def _step_errors(
    world_T_rigs: np.ndarray, true_T_rigs: np.ndarray, steps: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of steps i to i + 1: translation (S,), truth units, and rotation (S,), radians."""
    translations, rotations = [], []
    for poses, factor in ((world_T_rigs, scale), (true_T_rigs, 1.0)):
        rig_R_world = np.swapaxes(poses[steps, :3, :3], 1, 2)
        baselines = factor * (poses[steps + 1, :3, 3] - poses[steps, :3, 3])
        translations.append(np.einsum("nij,nj->ni", rig_R_world, baselines))
        rotations.append(rig_R_world @ poses[steps + 1, :3, :3])
    errors = np.linalg.norm(translations[0] - translations[1], axis=1)
    return errors, rotation_angle(np.swapaxes(rotations[0], 1, 2) @ rotations[1])


def _pair_errors(world_T_rigs: np.ndarray, true_T_rigs: np.ndarray) -> np.ndarray:
    """Errors (N (N - 1) / 2,) in radians of the relative poses of all pairs i < j.

    The error is the larger of two angles: of the relative rotation, and between true and estimated
    direction to pose j, both in the axes of pose i. A true baseline under 1e-6 of the
    extent has no direction, so that the rotation alone counts. An estimate without baseline counts
    as a direction that is off by pi.
    """
    num = len(true_T_rigs)
    rotations, true_rotations = world_T_rigs[:, :3, :3], true_T_rigs[:, :3, :3]
    positions, true_positions = world_T_rigs[:, :3, 3], true_T_rigs[:, :3, 3]
    # With D = true_R_rig rig_R_world per pose, the relative rotation error of a pair is the
    # angle between its two D; four times the arc sine of half the chord of their quaternions.
    true_R_world = true_rotations @ np.swapaxes(rotations, 1, 2)
    quaternions = quaternion_from_rotation(true_R_world)
    # Pairs with a shorter baseline have no direction.
    shortest = 1e-6 * extent_of(true_positions)
    errors = []
    start = 0
    while start < num - 1:
        rows = np.arange(start, min(num - 1, start + max(1, _PAIRS_AT_ONCE // (num - start))))
        columns = np.arange(start + 1, num)
        q0, q1 = quaternions[rows, None], quaternions[None, columns]
        chord = np.minimum(np.linalg.norm(q0 - q1, axis=-1), np.linalg.norm(q0 + q1, axis=-1))
        rotation = 4 * np.arcsin(np.minimum(chord / 2, 1))
        # Both baselines in the true world, as the orientation of pose i places the estimate's.
        true_baselines = true_positions[None, columns] - true_positions[rows, None]
        baselines = positions[None, columns] - positions[rows, None]
        baselines = baselines @ np.swapaxes(true_R_world[rows], 1, 2)
        cross = np.linalg.norm(np.cross(baselines, true_baselines), axis=-1)
        dot = np.einsum("ijk,ijk->ij", baselines, true_baselines)
        direction = np.arctan2(cross, dot)
        direction[~baselines.any(axis=-1)] = np.pi
        direction[np.linalg.norm(true_baselines, axis=-1) < shortest] = 0
        errors.append(np.maximum(rotation, direction)[columns > rows[:, None]])
        start = rows[-1] + 1
    return np.concatenate(errors)
