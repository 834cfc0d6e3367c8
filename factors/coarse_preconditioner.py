"""About the inverse of H for conjugate gradients: each variable alone, and groups moved as one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from scipy.sparse import csr_matrix

from factors._schur_kernels import GROUP_DIM, add_pairs_of_groups
from factors.cholesky import DIM
from factors.pose_clusters import Groups
from factors.schur_complement import GroupVisits, SchurComplement

_LEAST_PART = 1e-10  # of its curvature, that is added to a motion of a group

Held = tuple[SchurComplement, np.ndarray, Sequence[GroupVisits]]  # of these variables, by groups

(potrf,) = get_lapack_funcs(("potrf",), dtype=np.float64)
(trsm,) = get_blas_funcs(("trsm",), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Coarse:
    """The exact solution for groups that turn, shift and stretch.

    With Jacobi's by variable it makes an additive preconditioner of two levels: that one corrects
    what is local, this one what drifts, for which iterations that pass news from frame to frame
    are slow. Nicolaides, "Deflation of conjugate gradients", 1987.
    """

    motion: csr_matrix  # (6 N, 7 G) of the variables by that of groups, of unit curvature
    lower: np.ndarray  # (7 G, 7 G) Cholesky factor of H as groups feel it

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
    """H as groups of variables feel it, factorized; None where it is not positive definite.

    Args:
        written: (N, 6, 6) blocks H[i, i], but for what comes from what is held.
        off_diagonal, pairs: (P, 6, 6), (P, 2) the rest of that part, i < j.
        held: complements of landmarks, the variables (F,) of their poses, and their visits.
        groups, bases: of the variables.
    """
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
    np.einsum("ii->i", target)[:] = 1.0 + _LEAST_PART
    lower, failed = potrf(target.T, lower=1, clean=0, overwrite_a=1)  # target.T: Fortran's order
    if failed:
        return None
    return Coarse(_motion(groups, bases * scale[places][groups.labels][:, None]), lower)


def _motion(groups: Groups, bases: np.ndarray) -> csr_matrix:
    """Motion (6 N, 7 G) of the variables by that of groups."""
    at = np.flatnonzero(groups.labels >= 0)
    rows = DIM * at[:, None, None] + np.arange(DIM)[:, None] + np.zeros(GROUP_DIM, np.int64)
    columns = GROUP_DIM * groups.labels[at][:, None, None] + np.arange(GROUP_DIM)
    columns = np.broadcast_to(columns, rows.shape)
    shape = DIM * len(bases), GROUP_DIM * groups.num
    return csr_matrix((bases[at].ravel(), (rows.ravel(), columns.ravel())), shape=shape)
