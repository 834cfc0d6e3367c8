"""Elimination of landmarks from linearized observations with any frame variables."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, bsr_array, csr_array

from factors._kernels import eliminate_linear_range
from factors._observations import covisible_pairs

_RELATIVE_DAMPING = 1e-12  # damping of a landmark, part of the sum of squares of its Jacobian


@dataclass(frozen=True, slots=True)
class LinearSystem:
    """Normal equations over K variables of each frame, frame after frame, then S shared ones."""

    cost: float  # at the linearization point
    gradient: np.ndarray  # (F K + S,) at the linearization point
    hessian: csr_array  # (F K + S, F K + S)


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
        num_frames: F.
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
    diagonal, gradient = np.zeros((num_frames, own, own)), np.zeros((num_frames, own))
    upper, to_shared = np.zeros((len(columns), own, own)), np.zeros((num_frames, own, common))
    shared, shared_gradient = np.zeros((common, common)), np.zeros(common)
    cost = eliminate_linear_range(
        0, len(offsets) - 1, offsets, frames, residuals[order], by_point[order], by_frame[order],
        by_shared[order], _RELATIVE_DAMPING, int(np.diff(offsets).max(initial=0)), starts, columns,
        diagonal, upper, to_shared, shared, gradient, shared_gradient,
    )  # fmt: skip
    size, rows = num_frames * own, np.arange(num_frames + 1)
    above = bsr_array((upper, columns, starts), shape=(size, size))
    among = above + above.T + bsr_array((diagonal, rows[:-1], rows), shape=(size, size))
    across = to_shared.reshape(size, common)
    hessian = block_array([[among, csr_array(across)], [csr_array(across.T), csr_array(shared)]])
    whole = np.concatenate([gradient.ravel(), shared_gradient])
    return LinearSystem(cost, whole, csr_array(hessian))
