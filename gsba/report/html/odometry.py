"""Data of the page's odometry figure: maps from above, side by side."""

from typing import Any

import numpy as np

from gsba.odometry import Odometry
from gsba.report.html.figures import viewing_axes

_MAX_FRAMES = 4000  # drawn frames, besides keyframes and the first frames after losses
_RELATIVE_GAP = 0.15  # between maps, part of the largest map's extent


def odometry_plan(found: Odometry) -> dict[str, Any]:
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
    gap, left = _RELATIVE_GAP * max((float(e.max()) for e in extents), default=0.0), 0.0
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
