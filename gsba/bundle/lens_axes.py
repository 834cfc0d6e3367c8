"""Axes of the lenses of each frame: those of the panorama, or turned by a stabiliser, which keeps
the heading while the camera turns with the walk."""

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from factors.bearing import tangent_basis
from gsba.bundle.families import numbered
from gsba.bundle.shared_parameters import (
    PARTS,
    ObservedRays,
    Weighted,
    cross_validate,
    frame_models,
    models_of,
    newton_step,
    predicts,
    sample_counts,
    validated,
)
from gsba.camera.lens import Lenses
from gsba.geometry import frames_beside, standing_length, unit
from gsba.types import Counts

logger = logging.getLogger(__name__)

TURNS = np.deg2rad([0.5, 1.5, 5.0])  # prior standard deviations of a frame's turn


@dataclass(frozen=True, slots=True)
class LensAxes:
    """Lenses with the axes of each frame."""

    lenses: Lenses  # with axes, if they are not the rig's
    gains: np.ndarray  # (PARTS,) float64, share of the robust cost of each part, of the sequence or
    # of its points, that lenses with these axes take off as others have them
    reason: str  # why axes are those of the rig, or fixed ones; empty if they are not
    counts: Counts  # of observations


def guess(rays: ObservedRays) -> LensAxes:
    """Lenses with axes that explain most with two centres: the rig's, turned ones, or the walk's;
    keypoints are seen from one centre, whose `band_rad` is kept."""
    keypoints, so_far, frames = rays.keypoints, rays.lenses, rays.keypoints.frames()
    tried = [replace(so_far, axes=axes) for axes in _candidates(rays)]

    def by_centres(rows: np.ndarray, by_start: np.ndarray, _: np.ndarray) -> np.ndarray:
        columns = []
        for under in tried:
            of = keypoints.bearings_rig[rows], frames[rows]
            clear = ~under.blended(*of)
            columns.append(clear[:, None, None] * under.by_centre(by_start, *of))
        return np.concatenate(columns, axis=2)

    systems, counts = models_of(replace(rays, most=20_000), by_centres)
    if not systems:
        return LensAxes(so_far, np.full(PARTS, np.nan), "too few points", counts)
    starts = range(0, 3 * len(tried), 3)
    tried_parts = [[part.of(slice(k, k + 3)) for part in systems] for k in starts]
    gains = np.array(
        [cross_validate(parts, partial(newton_step, curved=False)).gains for parts in tried_parts]
    )
    best = int(np.argmax(gains.sum(axis=1)))
    shares = gains / np.array([part.cost for part in systems])
    logger.debug("lens axes: gains %s %%", (100 * shares.mean(axis=1)).round(2).tolist())
    gain = gains[best] - np.maximum(gains[0], 0)
    if not predicts(gain.sum(keepdims=True)):  # of all parts together: with rough axes none is
        # significant alone
        return LensAxes(so_far, shares[0], "they look as the panorama does", counts)
    return LensAxes(tried[best], shares[best], "", counts)


def loosened(rays: ObservedRays) -> LensAxes:
    """Axes of each frame's own, the rig's yet, if turning them by some points predicts others.
    Keypoints are rays of the two lenses so far."""
    solved, keypoints, so_far = rays.solved, rays.keypoints, rays.lenses
    used = rays.drawn
    counts = sample_counts(solved.landmarks, used.solved.landmarks)
    frames, num = keypoints.frames(), len(solved.world_T_rigs)

    def by_axes(seen: Weighted) -> np.ndarray:
        there, bearings = frames[seen.rows], keypoints.bearings_rig[seen.rows]
        rotations = solved.world_T_rigs[there, :3, :3]
        by_start = -seen.by_point @ rotations
        by_start = by_start + so_far.inverse_stitch_radius * tangent_basis(bearings)
        return so_far.by_centre(by_start, bearings, there) @ by_turn(so_far)

    models = frame_models(used, by_axes)
    tried = [validated(models, np.full(2, width)) for width in TURNS]
    verdict = max(tried, key=lambda trial: float(trial.gains.sum()))
    shares = verdict.shares
    logger.debug("lens axes: %s %% of unseen points' cost", (100 * shares).round(2).tolist())
    if not verdict.predicts:
        return LensAxes(so_far, shares, "turning them does not predict unseen points", counts)
    return LensAxes(replace(so_far, axes=np.tile(np.eye(3), (num, 1, 1))), shares, "", counts)


def turned(lenses: Lenses, turns: np.ndarray) -> Lenses:
    """The lenses turned by turns (F, 2) rad about x and y of their frame, then level again. The
    front one's centre is on their axis then: it is there that they look."""
    assert lenses.axes is not None
    vectors = np.column_stack([turns, np.zeros(len(turns))])
    length = float(np.linalg.norm(lenses.centre))
    moved = lenses.axes @ Rotation.from_rotvec(vectors).as_matrix() @ (lenses.centre / length)
    return replace(lenses, axes=upright(moved), centre=np.array([0.0, 0, length]))


def by_turn(lenses: Lenses) -> np.ndarray:
    """Jacobian (3, 2) of the centre by turns of the lenses about x and y of their frame."""
    return np.cross(np.eye(3)[:2], lenses.centre).T


def upright(directions: np.ndarray) -> np.ndarray:
    """Axes (F, 3, 3) whose z is a direction (F, 3), and whose x is as level as it can be."""
    z = unit(directions)
    x = np.cross([0.0, 1, 0], z)
    vertical = np.linalg.norm(x, axis=1) < 1e-3
    x[vertical] = [1.0, 0, 0]
    y = unit(np.cross(z, x))
    return np.stack([np.cross(y, z), y, z], axis=2)


def _candidates(rays: ObservedRays) -> list[np.ndarray]:
    """Candidate axes (F, 3, 3), those of the rig first."""
    world_T_rigs = rays.solved.world_T_rigs
    fixed = np.tile([0.0, 0, 1], (len(world_T_rigs), 1))
    headings = _headings(world_T_rigs, numbered(rays.context.maps, len(world_T_rigs)))
    return [
        upright(directions @ Rotation.from_rotvec([0, yaw, 0]).as_matrix().T)
        for directions in (fixed, headings)
        for yaw in np.deg2rad([0.0, 45, 90, 135])
    ]


def _headings(world_T_rigs: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Level directions (F, 3) in which each rig goes in its map (F,), in its frame; of the nearest
    that does."""
    num = len(world_T_rigs)
    before, after = frames_beside(maps[1:] != maps[:-1])
    moved = world_T_rigs[after, :3, 3] - world_T_rigs[before, :3, 3]
    lengths = np.linalg.norm(moved, axis=1)
    going = np.flatnonzero(lengths > standing_length(lengths))
    if not len(going):
        return np.tile([0.0, 0, 1], (num, 1))
    nearest = going[np.abs(np.arange(num)[:, None] - going).argmin(axis=1)]
    local = np.einsum("fji,fj->fi", world_T_rigs[:, :3, :3], moved[nearest])
    local[:, 1] = 0
    local[np.linalg.norm(local, axis=1) == 0] = [0, 0, 1]
    return unit(local)
