"""A camera that turns but never moves: rotations alone, by Gauss-Newton under a robust loss, each
track's direction eliminated as the weighted mean of its rays."""

import logging
from dataclasses import replace

import numpy as np

from factors import tangent_basis
from gsba.bundle.reconstruction import assemble
from gsba.geometry import pose, unit
from gsba.types import CoarsePoses, Keypoints, PoseStatus, Reconstruction, Solution, Tracks

logger = logging.getLogger(__name__)

_COLUMNS = 384  # columns of the inverse computed at a time


def refine(
    found: Tracks,
    keypoints: Keypoints,
    world_T_rigs: np.ndarray,
    coarse: CoarsePoses,
    min_observations: int,
    parts: np.ndarray | None = None,
) -> Reconstruction:
    """Refine the rotations of frames that were taken from one place: a result without points, whose
    covariances are of rotations, NaN for positions.

    Args:
        found: which keypoints show one direction; some may be false.
        world_T_rigs: (F, 4, 4) rotations right but for the drift of a chain; positions are
            kept.
        coarse: poses that define the world.
        min_observations: frames with fewer count as unrefined.
        parts: (F,) int, 0 = frames that matches tie together, others alone; None = all are
            tied.
    """
    rotations, covariances, used = solve(world_T_rigs[:, :3, :3], found, keypoints)
    six = np.full((len(rotations), 6, 6), np.nan)
    six[:, :3, :3] = covariances
    solved = Solution.without_points(pose(rotations, world_T_rigs[:, :3, 3]))
    result = assemble(solved, six, keypoints, coarse, min_observations, components=parts)
    refined = np.where(used >= min_observations, PoseStatus.REFINED, PoseStatus.UNREFINED)
    return replace(result, pose_statuses=refined.astype(np.uint8))


def solve(
    world_R_rigs: np.ndarray, found: Tracks, keypoints: Keypoints
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations under which the rays of each track are parallel, from (F, 3, 3) of which the first
    is kept; some keypoints of a track may be false.

    Returns:
        (F, 3, 3) rotations; their covariances (F, 3, 3) in the rig frame, radians squared, with
        the first held; and how many observations of each frame (F,) were within the noise.
    """
    from scipy.spatial.transform import Rotation

    rotations, num = world_R_rigs.copy(), len(world_R_rigs)
    rows = keypoints.rows(found)
    bearings, sigmas = keypoints.bearings_rig[rows], keypoints.sigmas_rad[rows]
    wide, noise, weights = 10.0, 1.0, np.ones(len(rows))  # the loss is wide at the start
    system = None
    for _ in range(30):
        rays = np.einsum("oij,oj->oi", rotations[found.frames], bearings)
        pulls = ((weights / sigmas**2)[:, None] * rays).T  # towards the direction of each track
        sums = np.stack([np.bincount(found.points, p, found.num_points) for p in pulls], axis=1)
        bases = tangent_basis(unit(sums)[found.points])
        residuals = np.einsum("oij,oj->oi", bases, rays) / sigmas[:, None]
        lengths = np.linalg.norm(residuals, axis=1)
        noise = max(float(np.median(lengths)) / 1.1774, 1e-9)  # of a Rayleigh distribution
        weights = 1 / (1 + (lengths / (2.0 * wide * noise)) ** 2)  # Cauchy
        system, gradient = _system(rotations, bearings, bases, residuals, sigmas, weights, found)
        step = _factored(system).solve(-gradient[3:])
        turns = Rotation.from_rotvec(np.concatenate([np.zeros(3), step]).reshape(num, 3))
        rotations = rotations @ turns.as_matrix()
        if np.abs(step).max() < 1e-9 and wide == 1:  # radians
            break
        wide = max(0.5 * wide, 1.0)
    covariances = np.zeros((num, 3, 3))
    if system is not None:
        size = system.shape[0]
        blocks, factored = np.empty((size // 3, 3, 3)), _factored(system)
        for first in range(0, size, _COLUMNS):
            last = min(first + _COLUMNS, size)
            columns = factored.solve(np.eye(size, last - first, -first))
            for n in range(first // 3, last // 3):
                blocks[n] = columns[3 * n : 3 * n + 3, 3 * n - first : 3 * n + 3 - first]
        covariances[1:] = noise**2 * blocks
        linearised = found, bearings, bases, residuals, weights / sigmas
        covariances *= _excess(rotations, sigmas, noise, linearised)[:, None, None]
    used = np.bincount(found.frames[weights > 0.1], minlength=num)
    logger.info("rotations of %d frames from %d observations", num, int(used.sum()))
    return rotations, covariances, used


def _system(
    rotations: np.ndarray,
    bearings: np.ndarray,
    bases: np.ndarray,
    residuals: np.ndarray,
    sigmas: np.ndarray,
    weights: np.ndarray,
    found: Tracks,
):
    """Reduced normal equations: sparse (3F - 3, 3F - 3) without the first frame, gradient (3F,)."""
    from scipy.sparse import csr_matrix, diags

    num, count = len(rotations), len(bearings)
    roots = np.sqrt(weights) / sigmas
    jacobian = _jacobian(rotations, bearings, bases, found) * roots[:, None, None]
    columns = np.repeat(3 * found.frames[:, None] + np.arange(3), 2, axis=0)
    rows = np.repeat(np.arange(2 * count), 3)
    values = jacobian.reshape(-1)
    shape = (2 * count, 3 * num)
    whitened = csr_matrix((values, (rows, columns.reshape(-1))), shape=shape)
    # Each track's direction is eliminated: it is the mean of its rays.
    member = 2 * np.repeat(found.points, 2) + np.tile([0, 1], count)
    gather = csr_matrix(
        (np.repeat(roots, 2), (member, np.arange(2 * count))),
        shape=(2 * found.num_points, shape[0]),
    )
    totals = np.bincount(found.points, roots**2, found.num_points)
    shared, inverses = gather @ whitened, np.repeat(1 / np.maximum(totals, 1e-300), 2)
    explained = shared.T @ diags(inverses) @ shared
    system = (whitened.T @ whitened - explained).tocsc()[3:, 3:]
    right = (np.sqrt(weights)[:, None] * residuals).reshape(-1)
    return system, whitened.T @ right - shared.T @ (inverses * (gather @ right))


def _jacobian(
    rotations: np.ndarray, bearings: np.ndarray, bases: np.ndarray, found: Tracks
) -> np.ndarray:
    """Jacobian (O, 2, 3) of residuals by turns of their frames, radians; sigmas are left out."""
    turned = np.cross(np.eye(3)[None], bearings[:, None, :])  # (O, axis, 3): a turn about each axis
    return np.einsum("oij,ojl,okl->oik", bases, rotations[found.frames], turned)


def _excess(
    rotations: np.ndarray,
    sigmas: np.ndarray,
    noise: float,
    linearised: tuple[Tracks, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Factors (F,), at least 1, by which covariances of rotations grow as residuals of a region of
    the sphere are alike: those of a hand that moves are the parallax of what is seen there.

    The cluster-robust estimator of Liang and Zeger, Biometrika 1986, relative to the usual one.
    """
    found, bearings, bases, residuals, pulls = linearised
    jacobian = _jacobian(rotations, bearings, bases, found)
    gradients = np.einsum("oik,oi,o->ok", jacobian, residuals, pulls)
    information = np.einsum("oik,oil,o->okl", jacobian, jacobian, pulls / sigmas)
    octants = (bearings > 0) @ np.array([1, 2, 4])
    num, blocks = len(rotations), np.zeros((len(rotations), 3, 3))
    sums = np.zeros((num, 8, 3))
    np.add.at(sums, (found.frames, octants), gradients)
    np.add.at(blocks, found.frames, information)
    inverses = np.linalg.pinv(blocks)
    robust = np.einsum("fij,fcj->fci", inverses, sums)
    alike = np.sum(robust**2, axis=(1, 2)) * 8 / (8 - 3)  # degrees of freedom of a rotation
    independent = noise**2 * np.trace(inverses, axis1=1, axis2=2)
    return np.maximum(alike / np.maximum(independent, 1e-300), 1.0)


def _factored(system):
    """Factors of damped normal equations, for any number of right sides."""
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    damping = 1e-9 * float(np.mean(system.diagonal())) + 1e-12
    return splu((system + damping * identity(system.shape[0])).tocsc())
