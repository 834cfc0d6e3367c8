"""Notes for the user on GPS fixes."""

import logging
import math
from collections.abc import Mapping
from typing import Any

from gsba.report.findings import named

logger = logging.getLogger(__name__)


def notes_on_gps(content: Mapping[str, Any], num_frames: int) -> list[str]:
    """Notes on used and false fixes.

    Args:
        content: report of the family, see `gsba.bundle.gps_factors.GpsFactors.report`.
        num_frames: frames of the run.
    """
    if not content["taken"]:
        why = (
            "most of them are further from where the images put the frames than their noise and a "
            "map's drift allow, or the path is shorter than their error"
        )
        if content["contradicted"]:
            why = "they would bend the map by more than its images and their noise allow"
        note = (
            f"GPS was not used: the images contradict its {content['fixes']} positions: {why}; "
            "check the positions, their noise and their clock"
        )
        logger.warning(note)
        return [note]
    typical, claimed = content["rms_m_east_north_up"], content["sigma_m_east_north_up"][0]
    across, false = math.hypot(typical[0], typical[1]), content["false_fixes"]
    note = (
        f"GPS held {content['used']} of {num_frames} frames: residuals are {across:.2g} m "
        f"horizontally and {typical[2]:.2g} m vertically (rms; the assumed sigma is {claimed:.2g} "
        "m per axis)"
    )
    if false:
        note += f"; {len(false)} fixes are outliers: {named(false, 'gps.false_fixes')}"
    return [note]
