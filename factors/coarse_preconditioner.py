"""A two-level preconditioner for conjugate gradients: single variables, and groups moved as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.sparse import csr_matrix

from factors.cholesky import DIM
from factors.schur_complement import (
    GROUP_DIM,
    GroupVisits,
    SchurComplement,
    add_pairs_of_groups,
    merge_capped,
)

_MIN_GROUP_SIZE = 4  # least frames of a group


@dataclass(frozen=True, slots=True)
class Groups:
    """Variables that move together."""

    labels: np.ndarray  # (N,) int64, group of each; -1 = none
    num: int  # G

    def bases(self, poses: np.ndarray) -> np.ndarray:
        """Motion (N, 6, 7) of each variable when its group rotates, translates, scales in the
        world; poses: (N, 12) rows [world_R_rig row-major, rig_in_world], arbitrary for other
        variables."""
        there = self.labels >= 0
        labels = self.labels[there]
        rotations = np.swapaxes(poses[there, :9].reshape(-1, 3, 3), 1, 2)  # rig_R_world
        sums = np.zeros((self.num, 3))
        np.add.at(sums, labels, poses[there, 9:])
        sizes = np.maximum(np.bincount(labels, minlength=self.num), 1)
        arms = poses[there, 9:] - (sums / sizes[:, None])[labels]
        turning = np.zeros((len(arms), 3, 3))  # turn x arm
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            turning[:, i, j], turning[:, j, i] = arms[:, k], -arms[:, k]
        out = np.zeros((len(poses), 6, GROUP_DIM))
        moved = np.zeros((len(arms), 6, GROUP_DIM))
        moved[:, :3, :3], moved[:, 3:, :3] = rotations, rotations @ turning
        moved[:, 3:, 3:6] = rotations
        moved[:, 3:, 6] = np.einsum("nij,nj->ni", rotations, arms)
        out[there] = moved
        return out


def covisible_groups(num: int, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Groups:
    """Groups of the most covisible variables, none much larger than another.

    Pairs, rows (P, 2) of variables and the number (P,) of landmarks that each two share, normalised
    by both variables' totals, join groups, the strongest first (Kruskal's algorithm), as long as
    they stay small. Variables without a pair stay alone.
    """
    rows = np.concatenate([p for p, _ in pairs])
    shared = np.concatenate([s for _, s in pairs]).astype(np.float64)
    totals = np.bincount(rows.ravel(), np.repeat(shared, 2), minlength=num)
    weights = shared / np.sqrt(totals[rows[:, 0]] * totals[rows[:, 1]])
    most = 24 * num  # strongest pairs of a frame that are used, on average
    if len(weights) > most:
        least = np.partition(weights, len(weights) - most)[len(weights) - most]
        rows, weights = rows[weights >= least], weights[weights >= least]
    rows = rows[np.argsort(-weights, kind="stable")].astype(np.int64)
    # groups whose dense system is factorized within seconds
    size = max(_MIN_GROUP_SIZE, -(-num // 640))
    labels, sizes = np.arange(num), np.ones(num, np.int64)
    merge_capped(rows[:, 0].copy(), rows[:, 1].copy(), size, labels, sizes)
    labels[totals == 0] = -1
    found, labels = np.unique(labels, return_inverse=True)
    alone = int(len(found) > 0 and found[0] < 0)
    return Groups(labels.astype(np.int64) - alone, len(found) - alone)


_RELATIVE_DAMPING = 1e-10  # part of its curvature added to a motion of a group

Held = tuple[SchurComplement, np.ndarray, Sequence[GroupVisits]]  # complement, its variables,
# visits by groups

(potrf,) = get_lapack_funcs(("potrf",), dtype=np.float64)
(trsm,) = get_blas_funcs(("trsm",), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Coarse:
    """The exact solution for groups that rotate, translate and scale.

    With Jacobi's preconditioner by variable it forms an additive one of two levels: Jacobi's
    corrects local errors, this one drift, for which iterations between neighbouring frames converge
    slowly. Nicolaides, "Deflation of conjugate gradients", 1987.
    """

    motion: csr_matrix  # (6 N, 7 G) motion of the variables by that of groups, of unit curvature
    lower: np.ndarray  # (7 G, 7 G) Cholesky factor of H projected to groups

    def solve(self, residual: np.ndarray) -> np.ndarray:
        """Motion (N, 6, R) of groups under forces (N, 6, R)."""
        flat = residual.reshape(-1, residual.shape[2])
        moved = trsm(1.0, self.lower, np.asfortranarray(self.motion.T @ flat), lower=1)
        moved = trsm(1.0, self.lower, moved, lower=1, trans_a=1, overwrite_b=1)
        return (self.motion @ moved).reshape(residual.shape)


def coarse_system(
    written: np.ndarray,
    off_diagonal: np.ndarray,
    pairs: np.ndarray,
    held: Sequence[Held],
    groups: Groups,
    bases: np.ndarray,
) -> Coarse | None:
    """H projected to groups of variables, factorized; None if it is not positive definite. H is
    `written (N, 6, 6)`, `off_diagonal (P, 6, 6)` of `pairs (P, 2)`, i < j, and complements of
    landmarks held in factored form, each with its variables (F,) and visits by groups."""
    num = GROUP_DIM * groups.num
    target = np.zeros((num, num))  # its upper triangle
    own = written.copy()
    for complement, rows, _ in held:
        own[rows] += complement.own
    blocks, at = np.zeros((groups.num, GROUP_DIM, GROUP_DIM)), groups.labels >= 0
    np.add.at(blocks, groups.labels[at], np.swapaxes(bases[at], 1, 2) @ own[at] @ bases[at])
    places = GROUP_DIM * np.arange(groups.num)[:, None] + np.arange(GROUP_DIM)
    target[places[:, :, None], places[:, None]] = blocks
    add_pairs_of_groups(pairs, off_diagonal, groups.labels, bases, target)
    for complement, rows, visits in held:
        complement.add_to_groups(groups.labels[rows], bases[rows], visits, target)
    curvature = np.diagonal(target)
    scale = np.where(curvature > 0, 1 / np.sqrt(np.where(curvature > 0, curvature, 1.0)), 1.0)
    target *= scale[:, None]
    target *= scale
    np.einsum("ii->i", target)[:] = 1.0 + _RELATIVE_DAMPING
    lower, failed = potrf(target.T, lower=1, clean=0, overwrite_a=1)  # target.T: Fortran's order
    if failed:
        return None
    return Coarse(_motion(groups, bases * scale[places][groups.labels][:, None]), lower)


def _motion(groups: Groups, bases: np.ndarray) -> csr_matrix:
    """Motion (6 N, 7 G) of the variables, given that of groups."""
    at = np.flatnonzero(groups.labels >= 0)
    rows = DIM * at[:, None, None] + np.arange(DIM)[:, None] + np.zeros(GROUP_DIM, np.int64)
    columns = GROUP_DIM * groups.labels[at][:, None, None] + np.arange(GROUP_DIM)
    columns = np.broadcast_to(columns, rows.shape)
    shape = DIM * len(bases), GROUP_DIM * groups.num
    return csr_matrix((bases[at].ravel(), (rows.ravel(), columns.ravel())), shape=shape)
