"""What GPS factors had to say, for report.json, and what to note of it."""

import logging
from typing import Any

import numpy as np

from gsba.bundle.fixes import FrameFixes
from gsba.bundle.gps_factors import Anchors
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

_MOST_NAMED = 20  # frames of false fixes that are named


def of_gps(
    fixes: FrameFixes, anchors: Anchors | None, world_T_rigs: np.ndarray, frames: FrameSet
) -> tuple[dict[str, Any], list[str]]:
    """How many fixes held the poses, how far off they are, and which were false.

    Args:
        fixes: of the frames.
        anchors: the same in the world of the poses; None = they do not lie as the frames do.
        world_T_rigs: (F, 4, 4) refined poses.
        frames: their names.
    """
    said: dict[str, Any] = {"fixes": len(fixes), "taken": anchors is not None}
    if anchors is None:
        note = (
            f"GPS had no say: its {len(fixes)} positions and the frames' have nothing in common; "
            "check the clock, and that the walk is longer than positions are wrong"
        )
        logger.warning(note)
        return said | {"used": 0}, [note]
    used = np.flatnonzero(anchors.used)
    off = np.empty((len(used), 3))
    for number, fit in anchors.level_from_map.items():
        inside = anchors.maps == number
        carried = fit.points(world_T_rigs[anchors.frames[inside], :3, 3])
        off[inside] = carried - fixes.positions[used[inside]]
    false = [frames.names[f] for f in fixes.frames[~anchors.used]]
    lengths = np.linalg.norm(off, axis=1)
    typical = np.sqrt(np.mean(off**2, axis=0))
    said |= {
        "used": len(used),
        "false_fixes": false,
        "residual_m": {"median": np.median(lengths), "most": lengths.max()},
        "rms_m_east_north_up": typical,
        "sigma_m_east_north_up": np.median(fixes.sigmas, axis=0),
        "metres_per_unit": {str(n): fit.scale for n, fit in anchors.level_from_map.items()},
    }
    across, claimed = np.hypot(typical[0], typical[1]), np.median(fixes.sigmas[:, 0])
    note = (
        f"GPS held {len(used)} of {len(frames)} frames: they are {across:.2g} m off across and "
        f"{typical[2]:.2g} m up (rms; positions are taken to be right to {claimed:.2g} m per axis)"
    )
    if false:
        more = "" if len(false) <= _MOST_NAMED else f", ... {len(false) - _MOST_NAMED} more"
        note += f"; {len(false)} false: {', '.join(false[:_MOST_NAMED])}{more}"
    return said, [note]
