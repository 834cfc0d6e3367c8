"""A video's odometry as the page draws it: from above, its maps side by side."""

from typing import Any

import numpy as np

from gsba.odometry import Odometry
from gsba.report.html.figures import viewing_axes

_MAX_FRAMES = 4000  # that are drawn; keyframes and ends of losses are among them
_GAP = 0.15  # between maps, parts of the extent of the largest


def odometry_plan(found: Odometry) -> dict[str, Any]:
    """Maps from above, each in its own world and unit, one beside the other.

    Returns:
        "summary", a line; "maps", of each "positions" (P, 2), "keyframes" (P,) bool and "lost" (P,)
        bool, whether frames before were lost; "loops" and "joins" (L, 2, 2), positions of the two
        frames of each.
    """
    numbers, level = found.maps_in_turn(), np.full((len(found), 2), np.nan)
    rows_of = [np.flatnonzero(numbers == n) for n in range(1, int(numbers.max(initial=0)) + 1)]
    for rows in rows_of:
        poses = found.world_T_rigs[rows]
        level[rows] = poses[:, :3, 3] @ viewing_axes(poses)[0][:2].T
    extents = [np.ptp(level[rows], axis=0) for rows in rows_of]
    gap, left = _GAP * max((float(e.max()) for e in extents), default=0.0), 0.0
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
