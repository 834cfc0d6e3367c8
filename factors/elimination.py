"""Elimination of landmarks from linearized observations with any frame variables."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, bsr_array, csr_array

from factors._linear_kernels import eliminate_linear_range
from factors._observations import covisible_pairs

_RELATIVE_DAMPING = 1e-12  # damping of a landmark, part of the sum of squares of its Jacobian


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """Normal equations over K variables of each frame, frame after frame, then S shared ones."""

    cost: float  # at the linearization point
    gradient: np.ndarray  # (F K + S,) at the linearization point
    hessian: csr_array  # (F K + S, F K + S)


@dataclass(slots=True)
class Eliminated:
    """Sums of a linear least-squares problem whose landmarks are eliminated, run by run.

    Variables are K of each frame and S of all frames.
    """

    starts: np.ndarray  # (F + 1,) int64 and
    columns: np.ndarray  # (P,) int64: covisible frame pairs f < g as sorted CSR rows
    diagonal: np.ndarray  # (F, K, K) float64
    off_diagonal: np.ndarray  # (P, K, K)
    to_shared: np.ndarray  # (F, K, S)
    shared: np.ndarray  # (S, S)
    gradient: np.ndarray  # (F, K)
    shared_gradient: np.ndarray  # (S,)
    cost: float = 0.0  # half the squares that no landmark takes up

    @classmethod
    def zeros(cls, starts: np.ndarray, columns: np.ndarray, own: int, common: int) -> "Eliminated":
        """Nothing added yet, of `own` variables of each frame and `common` ones of all."""
        num, pairs = len(starts) - 1, len(columns)
        sums = np.zeros((num, own, own)), np.zeros((pairs, own, own)), np.zeros((num, own, common))
        of_all = np.zeros((common, common)), np.zeros((num, own)), np.zeros(common)
        return cls(starts, columns, *sums, *of_all)

    def add(
        self,
        offsets: np.ndarray,
        frames: np.ndarray,
        residuals: np.ndarray,
        by_point: np.ndarray,
        by_frame: np.ndarray,
        by_shared: np.ndarray,
    ) -> None:
        """Add landmarks: each has observations offsets[j] to offsets[j + 1], sorted by frame.

        Args: see `eliminate`.
        """
        self.cost += eliminate_linear_range(
            0, len(offsets) - 1, offsets, frames, residuals, by_point, by_frame, by_shared,
            _RELATIVE_DAMPING, int(np.diff(offsets).max(initial=0)), self.starts, self.columns,
            self.diagonal, self.off_diagonal, self.to_shared, self.shared, self.gradient,
            self.shared_gradient,
        )  # fmt: skip


def eliminate(
    num_frames: int,
    frames: np.ndarray,
    points: np.ndarray,
    residuals: np.ndarray,
    by_point: np.ndarray,
    by_frame: np.ndarray,
    by_shared: np.ndarray,
) -> LinearSystem:
    """The Schur complement of landmarks in a linear least-squares problem.

    Args:
        frames, points: (O,) int, frame and landmark of each observation.
        residuals: (O, 2) whitened.
        by_point: (O, 2, 3) Jacobian by the landmark.
        by_frame: (O, 2, K) Jacobian by the variables of the frame.
        by_shared: (O, 2, S) Jacobian by the shared variables.
    """
    own, common = by_frame.shape[2], by_shared.shape[2]
    order = np.lexsort((frames, points))
    frames, points = np.asarray(frames)[order].astype(np.int64), np.asarray(points)[order]
    offsets = np.flatnonzero(np.diff(points, prepend=-1, append=-1))
    starts, columns, _ = covisible_pairs(offsets, frames, num_frames)
    sums = Eliminated.zeros(starts, columns, own, common)
    sums.add(offsets, frames, residuals[order], by_point[order], by_frame[order], by_shared[order])
    size, rows = num_frames * own, np.arange(num_frames + 1)
    above = bsr_array((sums.off_diagonal, columns, starts), shape=(size, size))
    among = above + above.T + bsr_array((sums.diagonal, rows[:-1], rows), shape=(size, size))
    across = sums.to_shared.reshape(size, common)
    hessian = block_array(
        [[among, csr_array(across)], [csr_array(across.T), csr_array(sums.shared)]]
    )
    whole = np.concatenate([sums.gradient.ravel(), sums.shared_gradient])
    return LinearSystem(sums.cost, whole, csr_array(hessian))
