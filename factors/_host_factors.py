"""A landmark block as ordinary GTSAM factors, one for the landmarks of each first frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np

from factors._kernels import eliminate_range, polish_range
from factors._terms import pose_rows
from factors.compiled import kernel_and_part

if TYPE_CHECKING:
    from factors.landmarks import LandmarkBlock

_kernel, _ = kernel_and_part()
_POLISH_TOLERANCE = 1e-12  # of a landmark's cost
_POLISH_STEPS = 50  # at each evaluation, so that the error is a function of the poses alone


def host_factors(block: LandmarkBlock) -> list[gtsam.CustomFactor]:
    """Factors on poses alone whose errors add up to the block's robust cost.

    The landmarks of a group are eliminated inside the callback, each at its best for the poses
    asked about. Where derivatives are asked for too, they become the block's current ones.
    """
    offsets, frames = block._obs.offsets, block._obs.frames
    seen = np.flatnonzero(np.diff(offsets))  # landmarks without observations say nothing
    hosts = frames[offsets[seen]]  # observations are sorted by frame: the first one
    bounds = np.flatnonzero(np.diff(hosts, prepend=-1))
    return [
        _host_factor(block, int(rows[0]), int(rows[-1]) + 1)
        for rows in np.split(seen, bounds[1:])
        if len(rows)
    ]


def _host_factor(block: LandmarkBlock, first: int, last: int) -> gtsam.CustomFactor:
    """One factor for the landmarks first..last of the block."""
    obs = block._obs
    rows = slice(int(obs.offsets[first]), int(obs.offsets[last]))
    global_frames, local_frames = np.unique(obs.frames[rows], return_inverse=True)
    local = obs._replace(
        offsets=obs.offsets[first : last + 1] - obs.offsets[first],
        frames=local_frames.astype(np.int32),
        kinds=obs.kinds[rows],
        families=obs.families[rows],
        measurements=obs.measurements[rows],
        whiteners=obs.whiteners[rows],
    )
    keys = [block.pose_keys[f] for f in global_frames]
    num = len(keys)
    upper_rows, upper_columns = np.triu_indices(num, 1)
    row_starts = np.concatenate([[0], np.cumsum(np.arange(num - 1, -1, -1))]).astype(np.int64)
    columns = upper_columns.astype(np.int64)

    def move(poses: np.ndarray) -> tuple[np.ndarray, float]:
        start, no_steps = block._points[first:last], np.zeros((num, 6))
        points, costs = np.empty_like(start), np.empty(last - first)
        polish_range(
            0, last - first, local, start, poses, poses, no_steps, False, _POLISH_STEPS,
            _POLISH_TOLERANCE, costs, points, costs,
        )  # fmt: skip
        return points, float(costs.sum())

    def error(_factor, values: gtsam.Values, jacobians) -> np.ndarray:
        poses = pose_rows(values, keys)
        points, cost = move(poses)
        out = np.zeros(6 * num + 1)
        if jacobians is not None:
            block._points[first:last] = points
            diagonal, gradient = np.zeros((num, 6, 6)), np.zeros((num, 6))
            off_diagonal = np.zeros((len(columns), 6, 6))
            eliminate_range(
                0, last - first, local, points, poses, row_starts, columns, diagonal, off_diagonal,
                gradient, np.zeros(len(block.families)), np.empty(last - first),
            )  # fmt: skip
            H = np.zeros((num, 6, num, 6))
            H[np.arange(num), :, np.arange(num), :] = diagonal
            H[upper_rows, :, upper_columns, :] = off_diagonal
            root = H.reshape(6 * num, 6 * num)
            out[:-1] = _square_root(root, gradient.ravel())
            padded = np.vstack([root, np.zeros((1, 6 * num))])
            for i in range(num):
                jacobians[i] = np.asfortranarray(padded[:, 6 * i : 6 * i + 6])
        out[-1] = np.sqrt(max(2 * cost - float(out @ out), 0.0))
        return out

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6 * num + 1), keys, error)


@_kernel
def _square_root(H, gradient):
    """Upper R with R^T R = H in place, from H's upper triangle, and e with R^T e = gradient.

    H is positive semidefinite (the gauge is free): a direction without curvature gets a zero row,
    and carries no gradient either.
    """
    num = len(H)
    e = np.zeros(num)
    scale = np.zeros(num)
    for i in range(num):
        scale[i] = H[i, i]
        H[i, :i] = 0.0
    for i in range(num):
        if not H[i, i] > 1e-10 * scale[i]:
            H[i, i:] = 0.0
            continue
        H[i, i:] /= np.sqrt(H[i, i])
        e[i] = gradient[i]
        for k in range(i):
            e[i] -= H[k, i] * e[k]
        e[i] /= H[i, i]
        for k in range(i + 1, num):
            H[k, k:] -= H[i, k] * H[i, k:]
    return e
