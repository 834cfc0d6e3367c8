"""Findings on GPS factors, for report.json, and notes for the user."""

import logging
from typing import Any

import numpy as np

from gsba.bundle.fixes import FrameFixes
from gsba.bundle.gps_factors import Anchors
from gsba.report.findings import named
from gsba.types import FrameSet

logger = logging.getLogger(__name__)


def of_gps(
    fixes: FrameFixes, anchors: Anchors | None, world_T_rigs: np.ndarray, frames: FrameSet
) -> tuple[dict[str, Any], list[str]]:
    """Used and false fixes, and their residuals.

    Args:
        fixes: fixes of the frames.
        anchors: fixes in the world of the poses; None = they are not correlated with the poses.
        world_T_rigs: (F, 4, 4) refined poses.
        frames: frames of the run, for their names.

    Returns:
        Content of report.json and notes.
    """
    content: dict[str, Any] = {"fixes": len(fixes), "taken": anchors is not None}
    if anchors is None:
        note = (
            f"GPS was not used: its {len(fixes)} positions and the frames' are not correlated; "
            "check its clock, and that the path is longer than the error of the positions"
        )
        logger.warning(note)
        return content | {"used": 0}, [note]
    used = np.flatnonzero(anchors.used)
    off = np.empty((len(used), 3))
    for number, fit in anchors.level_from_map.items():
        inside = anchors.maps == number
        carried = fit.points(world_T_rigs[anchors.frames[inside], :3, 3])
        off[inside] = carried - fixes.positions[used[inside]]
    false = [frames.names[f] for f in fixes.frames[~anchors.used]]
    lengths = np.linalg.norm(off, axis=1)
    typical = np.sqrt(np.mean(off**2, axis=0))
    content |= {
        "used": len(used),
        "false_fixes": false,
        "residual_m": {"median": np.median(lengths), "most": lengths.max()},
        "rms_m_east_north_up": typical,
        "sigma_m_east_north_up": np.median(fixes.sigmas, axis=0),
        "metres_per_unit": {str(n): fit.scale for n, fit in anchors.level_from_map.items()},
    }
    across, claimed = np.hypot(typical[0], typical[1]), np.median(fixes.sigmas[:, 0])
    note = (
        f"GPS held {len(used)} of {len(frames)} frames: residuals are {across:.2g} m horizontally "
        f"and {typical[2]:.2g} m vertically (rms; the assumed sigma is {claimed:.2g} m per axis)"
    )
    if false:
        note += f"; {len(false)} fixes are outliers: {named(false, 'gps.false_fixes')}"
    return content, [note]
