"""Consistency of covariances: normalised errors against the truth, and NEES (Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 5.4).

The gauge of covariances fixes the first pose and its distance to the furthest position: the truth
is aligned by the similarity that makes those agree, and the furthest frame has five degrees of
freedom tested. Errors along a path are correlated: the expected interval is measured on samples
that the run drew from the joint distribution of its poses.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from gsba.evaluate.trajectory import TOLERANCE_S, aligned_rows
from gsba.geometry import adjoint, furthest, inverse, relative_steps, step_covariances
from gsba.log import GsbaError
from gsba.similarity import Sim3
from gsba.trajectory.association import matched_in_time
from gsba.types import Reconstruction, Trajectory

EXPECTED = 0.95  # share of sampled errors within the expected interval


@dataclass(frozen=True, slots=True)
class Statistic:
    """Statistic of the errors, and its interval for errors distributed by the covariances."""

    value: float
    low: float  # lower end of the interval that holds EXPECTED of the samples
    high: float  # its upper end


@dataclass(frozen=True, slots=True)
class Claims:
    """Statistics of errors normalised by their covariances."""

    num: int  # number of poses or steps
    rotation: Statistic  # rms of rotation error / sigma over these and the axes of the rig
    position: Statistic  # rms of position error / sigma over these and the axes of the rig
    nees: Statistic  # normalised estimation error squared e^T P^-1 e, mean over these; 6 if
    # consistent, less the degree of freedom that the gauge takes


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of pose covariances with the errors of the poses, in the covariances' gauge."""

    first: int  # frame whose pose the gauge fixes
    furthest: int  # frame whose distance from it the gauge fixes
    absolute: Claims  # of each pose
    consecutive: Claims | None  # of each step from one frame to the next; None = no two neighbours
    # have a true pose

    def to_json(self) -> dict:
        """Plain dict for json.dump."""
        return asdict(self)


def _claims(
    covariances: np.ndarray, held: np.ndarray, errors: np.ndarray, drawn: np.ndarray
) -> Claims:
    """Statistics of errors (N, 6) normalised by covariances (N, 6, 6), without positions along
    `held` (N, 3) unless 0, with intervals from sampled errors (D, N, 6)."""
    num = len(errors)
    axes = np.tile(np.eye(6), (num, 1, 1))  # orthogonal: rows are tangents in the rig frame
    kept = np.ones((num, 6), bool)  # axes that are tested; the gauge fixes the others
    for n in np.flatnonzero(held.any(axis=1)):
        axes[n, 3:, 3:] = np.linalg.svd(held[n, None])[2]  # its first row is along `held`
        kept[n, 3] = False
    along = axes @ covariances @ np.swapaxes(axes, 1, 2)
    along = np.where(kept[:, :, None] & kept[:, None, :], along, np.eye(6))
    sigmas = np.sqrt(np.maximum(np.einsum("nii->ni", along), 1e-300))  # along the axes
    values, vectors = np.linalg.eigh(along / (sigmas[:, :, None] * sigmas[:, None, :]))
    roots = vectors / np.sqrt(np.maximum(values, 1e-12))[:, None, :]
    whiteners, counts = roots @ np.swapaxes(vectors, 1, 2), kept.sum(axis=0)

    def measures(errors: np.ndarray) -> np.ndarray:
        """Rms rotation / sigma, rms position / sigma, and NEES (..., 3) of errors (..., N, 6)."""
        scaled = np.einsum("nij,...nj->...ni", axes, errors) / sigmas * kept
        squares = np.sum(scaled**2, axis=-2)
        rms = [
            np.sqrt(squares[..., part].sum(axis=-1) / counts[part].sum())
            for part in (slice(3), slice(3, 6))
        ]
        whitened = np.einsum("nij,...nj->...ni", whiteners, scaled)
        return np.stack([*rms, np.sum(whitened**2, axis=(-2, -1)) / num], axis=-1)

    tails = (1 - EXPECTED) / 2
    lows, highs = np.quantile(measures(drawn), [tails, 1 - tails], axis=0)
    three = zip(measures(errors), lows, highs, strict=True)
    return Claims(num, *(Statistic(*map(float, one)) for one in three))


def consistency_of(
    reconstruction: Reconstruction, timestamps: np.ndarray, truth: Trajectory
) -> Consistency:
    """Compare the covariances of a map's poses with the errors of these.

    Args:
        reconstruction: one map, from `load_run`.
        timestamps: (F,) times of its frames, seconds.
        truth: true poses in any world and scale; frames without a true pose are not tested.

    Raises:
        GsbaError: the run has no covariances, or the truth lacks the frames that fix the gauge.
    """
    poses, covariances = reconstruction.world_T_rigs, reconstruction.pose_covariances
    known = np.flatnonzero(np.isfinite(covariances).all(axis=(1, 2)))
    joint = reconstruction.joint_errors
    if joint is None or not len(known):
        raise GsbaError("the run has no covariances of its poses")
    far, _ = furthest(poses[:, :3, 3])
    rows, of_truth = matched_in_time(Trajectory(timestamps, poses), truth, TOLERANCE_S)
    for frame in (0, far):
        if not np.any(rows == frame):
            raise GsbaError(
                f"no true pose is within {TOLERANCE_S:g} s of {timestamps[frame]:.3f} s, the time "
                "of a frame that fixes the gauge of the covariances"
            )
    true_T_rigs = np.full_like(poses, np.nan)
    true_T_rigs[rows] = truth.world_T_rigs[of_truth]
    # The truth in the estimate's gauge: its first pose and its distance to frame `far`
    scales = [np.linalg.norm(some[far, :3, 3] - some[0, :3, 3]) for some in (poses, true_T_rigs)]
    for owner, length in zip(("run", "truth"), scales, strict=True):
        if not length > 0:
            raise GsbaError(f"the {owner} does not move: its positions determine no scale")
    scale = float(scales[0] / scales[1])
    local = Sim3.of(scale, np.eye(4)).poses(inverse(true_T_rigs[0]) @ true_T_rigs)
    true_T_rigs = poses[0] @ local

    toward = poses[far, :3, :3].T @ (poses[far, :3, 3] - poses[0, :3, 3])
    held = np.zeros((len(poses), 3))
    held[far] = toward / np.linalg.norm(toward)
    judged = np.intersect1d(rows[rows > 0], known)
    if not len(judged):
        raise GsbaError("no frame but the first one has both a true pose and a covariance")
    errors = _errors(poses, true_T_rigs)

    steps, true_steps = map(relative_steps, (poses, true_T_rigs))
    before = -adjoint(inverse(steps))  # step error = error + before @ error of the frame before
    of_steps = step_covariances(poses, covariances, joint.neighbours)
    step_errors = _errors(steps, true_steps)
    sure = np.isfinite(of_steps).all(axis=(1, 2)) & np.isfinite(step_errors).all(axis=1)
    chosen = np.flatnonzero(sure)
    only = held[1:].copy()
    only[1:] = 0  # the gauge fixes a step only if the furthest frame is the second one
    drawn = joint.draws.astype(np.float64)
    consecutive = None
    absolute = _claims(covariances[judged], held[judged], errors[judged], drawn[:, judged])
    if len(chosen):
        drawn = drawn[:, 1:] + np.einsum("fij,dfj->dfi", before, drawn[:, :-1])
        given = of_steps[chosen], only[chosen], step_errors[chosen], drawn[:, chosen]
        consecutive = _claims(*given)
    return Consistency(0, far, absolute, consecutive)


def format_consistency(found: Consistency, name: Callable[[int], str] = str) -> str:
    """Text table of the statistics; `name` gives the name of a frame."""
    header = ["", "poses", "rotation error/σ", "position error/σ", "NEES"]
    rows = [header]
    for title, claims in (("absolute", found.absolute), ("consecutive", found.consecutive)):
        if claims is None:
            continue
        cells = [
            f"{one.value:.2f} ({one.low:.2f} to {one.high:.2f})"
            for one in (claims.rotation, claims.position, claims.nees)
        ]
        rows.append([title, str(claims.num), *cells])
    lines = aligned_rows(rows)
    first, far = name(found.first), name(found.furthest)
    lines.append(f"in the gauge that fixes the pose of {first} and its distance to {far}; in")
    lines.append(f"brackets: {EXPECTED:.0%} interval of errors distributed by these covariances.")
    return "\n".join(lines)


def _errors(estimates: np.ndarray, truths: np.ndarray) -> np.ndarray:
    """Tangents (N, 6) [rotation, translation of the relative pose] from estimates to truths."""
    from scipy.spatial.transform import Rotation

    off = inverse(estimates) @ truths
    out, known = np.full((len(off), 6), np.nan), np.isfinite(off).all(axis=(1, 2))
    out[known, :3] = Rotation.from_matrix(off[known, :3, :3]).as_rotvec()
    out[known, 3:] = off[known, :3, 3]
    return out
