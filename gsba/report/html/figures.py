"""Data of the page's figures: map, displacements, shared points, residuals on the sphere."""

from typing import TYPE_CHECKING, Any

import numpy as np

from gsba.camera.sphere import erp_directions
from gsba.geometry import moved_to, rotation_angle
from gsba.memory import release_mapped_files
from gsba.report.report import medians_by_group
from gsba.types import CoarsePoses, Reconstruction, rows_across

if TYPE_CHECKING:
    from gsba.odometry import Odometry

_SPHERE_CELL_DEG = 5.0


def world_map(coarse: CoarsePoses, reconstruction: Reconstruction) -> dict[str, Any]:
    """Positions and a thinned cloud in viewing axes: two level ones, then up.

    Up is the mean up axis of the rigs, or, if they agree on none, the direction of the path's
    smallest extent. The first level axis is the direction of its largest extent.

    Returns:
        "before", "after" (F, 3), "points" (P, 3), "colors" (P, 3), and "up", the length of the
        rigs' mean up axis, 0..1.
    """
    positions = reconstruction.world_T_rigs[:, :3, 3]
    axes, upright = viewing_axes(reconstruction.world_T_rigs)
    centre = np.median(positions, axis=0)
    num = len(reconstruction.points_world)
    which = rows_across(num, 4000)  # points of the cloud on the map
    extent = float(np.ptp(positions, axis=0).max()) or 1.0
    points = (reconstruction.points_world[which] - centre) @ axes.T
    near = np.abs(points).max(axis=1, initial=0) < 3 * extent
    digits = max(0, 4 - int(np.floor(np.log10(extent))))
    return {
        "before": ((coarse.world_T_rigs[:, :3, 3] - centre) @ axes.T).round(digits),
        "after": ((positions - centre) @ axes.T).round(digits),
        "points": points[near].round(max(digits - 1, 0)),
        "colors": reconstruction.point_colors[which][near],
        "up": upright,
    }


def viewing_axes(world_T_rigs: np.ndarray) -> tuple[np.ndarray, float]:
    """Two level axes and up as rows (3, 3), world; and the length, 0..1, of the rigs' mean up."""
    positions = world_T_rigs[:, :3, 3] - world_T_rigs[:, :3, 3].mean(axis=0)
    mean_up = -world_T_rigs[:, :3, 1].mean(axis=0)
    upright = float(np.linalg.norm(mean_up))
    if upright > 0.5:
        up = mean_up / upright
    else:
        up = np.linalg.svd(np.vstack([positions, np.zeros((3, 3))]), full_matrices=False)[2][2]
    level = positions - np.outer(positions @ up, up)
    # A path without extent does not determine the first axis: any level one is used.
    anywhere = 1e-9 * (np.eye(3) - np.outer(up, up))
    first = np.linalg.svd(np.vstack([level, anywhere]), full_matrices=False)[2][0]
    first -= up * (first @ up)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(up, first), up]), upright


def displacements(
    coarse: CoarsePoses, reconstruction: Reconstruction
) -> tuple[np.ndarray, np.ndarray]:
    """Translation (F,), map units, and rotation (F,), degrees, of each frame by the refinement."""
    before, after = coarse.world_T_rigs, reconstruction.world_T_rigs
    moved = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    turned = rotation_angle(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3])
    return moved, np.degrees(turned)


def match_matrix(reconstruction: Reconstruction) -> dict[str, Any]:
    """Numbers of points that pairs of frames share, summed over bins of many frames.

    Returns:
        "cells" (N, N) int, symmetric with diagonal 0, and "frames_per_cell".
    """
    from scipy.sparse import csr_array

    num_frames = len(reconstruction.world_T_rigs)
    frames, points = reconstruction.observation_frames, reconstruction.observation_points
    ones = np.ones(len(frames), np.int32)
    shape = (num_frames, len(reconstruction.points_world))
    seen = csr_array((ones, (frames, points)), shape=shape)
    shared = (seen @ seen.T).tocoo()
    step = -(-num_frames // 240)
    num = -(-num_frames // step)
    off = shared.row != shared.col
    cells = np.zeros((num, num), np.int64)
    np.add.at(cells, (shared.row[off] // step, shared.col[off] // step), shared.data[off])
    return {"cells": cells, "frames_per_cell": step}


def residual_sphere(reconstruction: Reconstruction) -> dict[str, Any]:
    """Residuals by direction in the rig: they show errors of lenses and stitching.

    Returns:
        "rows", "columns" of an equirectangular grid; "median_deg" (rows, columns), the median
        length; "east_deg", "south_deg", the median of its components (predicted minus observed);
        "count". NaN where there are too few.
    """
    rows, columns = round(180 / _SPHERE_CELL_DEG), round(360 / _SPHERE_CELL_DEG)
    cells, values = [], []
    for some in reconstruction.pieces():
        # Cell (O,) uint16 of an equirectangular grid that each bearing (O, 3) points to.
        longitude = np.arctan2(some.observation_bearings[:, 0], some.observation_bearings[:, 2])
        latitude = np.arcsin(np.clip(some.observation_bearings[:, 1], -1, 1))
        column = np.clip(((longitude / np.pi + 1) / 2 * columns).astype(int), 0, columns - 1)
        row = np.clip(((latitude / np.pi + 0.5) * rows).astype(int), 0, rows - 1)
        cells.append((row * columns + column).astype(np.uint16))
        residuals = np.degrees(tangent_residuals(some)).T
        values.append(np.stack([np.hypot(*residuals), *residuals]).astype(np.float32))
        release_mapped_files()
    cell, num = np.concatenate(cells), rows * columns
    parts = zip(*values, strict=True)
    # cells with fewer observations stay empty
    medians = [
        medians_by_group(np.concatenate(part), cell, num, 5).reshape(rows, columns)
        for part in parts
    ]
    names = ("median_deg", "east_deg", "south_deg")
    return {
        "rows": rows,
        "columns": columns,
        "count": np.bincount(cell, minlength=num).reshape(rows, columns),
        **dict(zip(names, medians, strict=True)),
    }


def field_sphere(correction: tuple[float, ...]) -> dict[str, Any] | None:
    """Stitching field of the frames on the grid of `residual_sphere`, with the names of that.

    "east_deg" and "south_deg" are the offset from the observed to the corrected direction.
    """
    if not correction:
        return None
    from factors.sphere_field import SphereField

    rows, columns = round(180 / _SPHERE_CELL_DEG), round(360 / _SPHERE_CELL_DEG)
    bearings = erp_directions(columns).reshape(-1, 3)
    moved = np.degrees(SphereField(np.array(correction)).displacements(bearings))
    parts = [
        np.einsum("oi,oi->o", moved, axis).reshape(rows, columns) for axis in level_axes(bearings)
    ]
    return {
        "rows": rows,
        "columns": columns,
        "median_deg": np.hypot(*parts),
        "east_deg": parts[0],
        "south_deg": parts[1],
    }


def level_axes(bearings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (O, 3) to the east and to the south on the sphere."""
    level = np.maximum(np.hypot(bearings[:, 0], bearings[:, 2]), 1e-9)
    east = np.column_stack([bearings[:, 2], np.zeros(len(level)), -bearings[:, 0]]) / level[:, None]
    return east, np.cross(bearings, east)


def tangent_residuals(reconstruction: Reconstruction) -> np.ndarray:
    """Predicted minus observed direction (O, 2), radians east and south on the sphere."""
    frames = reconstruction.observation_frames
    poses = moved_to(reconstruction.world_T_rigs[frames], reconstruction.observation_origins)
    offsets = reconstruction.points_world[reconstruction.observation_points] - poses[:, :3, 3]
    predicted = np.einsum("oji,oj->oi", poses[:, :3, :3], offsets)
    predicted /= np.maximum(np.linalg.norm(predicted, axis=1, keepdims=True), 1e-12)
    bearings = reconstruction.observation_bearings
    across = np.column_stack([np.einsum("oi,oi->o", predicted, a) for a in level_axes(bearings)])
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.arctan2(sine, np.einsum("oi,oi->o", predicted, bearings)[:, None])
    return across * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)


_MAX_FRAMES = 4000  # drawn frames, besides keyframes and the first frames after losses


def odometry_plan(found: "Odometry") -> dict[str, Any]:
    """Maps from above, side by side, each in its own world and unit.

    Returns:
        "summary", a line of text; "maps", of each "positions" (P, 2), "keyframes" (P,) bool and
        "lost" (P,) bool, True if the frames before it were lost; "loops" and "joins" (L, 2, 2),
        positions of the two frames of each.
    """
    numbers, level = found.maps_in_turn(), np.full((len(found), 2), np.nan)
    rows_of = [np.flatnonzero(numbers == n) for n in range(1, int(numbers.max(initial=0)) + 1)]
    for rows in rows_of:
        poses = found.world_T_rigs[rows]
        level[rows] = poses[:, :3, 3] @ viewing_axes(poses)[0][:2].T
    extents = [np.ptp(level[rows], axis=0) for rows in rows_of]
    gap, left = 0.15 * max((float(e.max()) for e in extents), default=0.0), 0.0
    maps = []
    for rows, extent in zip(rows_of, extents, strict=True):
        level[rows] += [left, 0.0] - level[rows].min(axis=0)
        left += float(extent[0]) + gap
        lost = np.diff(rows, prepend=rows[0] - 1) > 1
        step = -(-len(rows) // _MAX_FRAMES)
        shown = lost | found.keyframes[rows] | (np.arange(len(rows)) % step == 0)
        maps.append(
            {
                "positions": level[rows[shown]],
                "keyframes": found.keyframes[rows[shown]],
                "lost": lost[shown],
            }
        )
    return {
        "summary": found.summary(),
        "maps": maps,
        "loops": level[found.loops],
        "joins": level[found.joins],
    }
