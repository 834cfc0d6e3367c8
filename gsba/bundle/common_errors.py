"""Errors that neighbouring frames have in common, which no residual shows: those of residuals,
enlarged and smoothed along the path by measured numbers (`benchmarks/results/covariances.md`)."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

from gsba.bundle.families import numbered
from gsba.geometry import furthest
from gsba.types import JointErrors
from gsba.types.records import slices

_AT_ONCE = 20  # errors drawn of all poses, in float64


def added(
    covariances: np.ndarray,
    joint: JointErrors,
    world_T_rigs: np.ndarray,
    components: np.ndarray | None = None,
) -> tuple[np.ndarray, JointErrors]:
    """Covariances (F, 6, 6) of poses, [rotation rad, translation], rig frames, NaN = none, with the
    errors in common, in the same gauge: in each map of components (F,), None = there is one, the
    first pose and its distance to the furthest position are held."""
    groups = numbered(components, len(world_T_rigs))
    known, num = np.isfinite(joint.draws).all(axis=(0, 2)), len(joint.draws)
    parts = [np.flatnonzero(known & (groups == group)) for group in np.unique(groups)]
    each, between = np.zeros_like(covariances), np.zeros_like(joint.neighbours)
    draws = joint.draws.copy()
    for some in slices(num, _AT_ONCE):
        errors = _in_common(joint.draws[some], world_T_rigs, parts)
        each += np.einsum("dfi,dfj->fij", errors, errors) / num
        between += np.einsum("dfi,dfj->fij", errors[:, :-1], errors[:, 1:]) / num
        others = (np.arange(some.start, some.stop) + 1) % num  # of which these are independent
        draws[others] += errors.astype(np.float32)
    return covariances + each, JointErrors(joint.neighbours + between, draws)


def _in_common(
    draws: np.ndarray, world_T_rigs: np.ndarray, parts: Sequence[np.ndarray]
) -> np.ndarray:
    """Errors in common (D, F, 6), enlarged and smoothed from draws of each part's frames (F',)."""
    rotations, errors = world_T_rigs[:, :3, :3], np.zeros(draws.shape)
    for rows in parts:
        if len(rows) > 1:
            turned = [rotations[rows] @ draws[:, rows, part, None] for part in _PARTS]
            # frames, standard deviation
            smooth = gaussian_filter1d(np.concatenate(turned, axis=2)[..., 0], 3.0, axis=1)
            positions = world_T_rigs[rows, :3, 3]
            offsets = positions - positions[0]
            far, distance = furthest(positions)
            turns, shifts = smooth[..., :3], smooth[..., 3:]
            shifts = shifts - shifts[:, :1] - np.cross(turns[:, :1], offsets)
            stretch = shifts[:, far] @ offsets[far] / max(distance, 1e-300) ** 2
            shifts = shifts - stretch[:, None, None] * offsets
            held = np.concatenate([turns - turns[:, :1], shifts], axis=-1)
            back = np.swapaxes(rotations[rows], 1, 2)
            turned = [back @ held[:, :, part, None] for part in _PARTS]
            # standard deviation over that of the other errors
            errors[:, rows] = 1.7 * np.concatenate(turned, axis=2)[..., 0]
    return errors


_PARTS = slice(3), slice(3, 6)  # rotation, translation
