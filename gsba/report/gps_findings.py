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
        content: report of the family, see `gsba.bundle.gps_factors.GpsFixes.report`.
        num_frames: frames of the run.
    """
    if not content["taken"]:
        note = (
            f"GPS was not used: its {content['fixes']} positions and the frames' are not "
            "correlated; check its clock, and that the path is longer than the error of the "
            "positions"
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
