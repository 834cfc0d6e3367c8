"""Findings on the gyro, for report.json, and notes for the user."""

import logging
from typing import Any

import numpy as np

from gsba.bundle.readout import CameraEstimate
from gsba.imu.alignment import Alignment

logger = logging.getLogger(__name__)


def of_gyro(
    found: Alignment,
    steps_used: float | None,
    readout: CameraEstimate | None,
) -> tuple[dict[str, Any], list[str]]:
    """Clock, bias and axes of a gyro, and the share of its steps that agree with the poses.

    Args:
        found: alignment of the gyro with the frames.
        steps_used: share of its steps that agree with the poses; None = it was not used.
        readout: estimated readout of the frames; None = a global shutter.

    Returns:
        Content of report.json and notes.
    """
    content: dict[str, Any] = {
        "taken": steps_used is not None,
        "reason": found.reason,
        "offset_s": found.clock.offset,
        "offset_sigma_s": found.offset_sigma,
        "rate": found.clock.rate,
        "bias_deg_per_s": np.rad2deg(found.sensor.bias),
        "scales": found.sensor.scales,
        "rig_R_imu": found.rig_R_imu,
        "axes_sigma_deg": np.rad2deg(found.axes_sigma),
        "noise_of_a_step_deg": np.rad2deg(found.noise),
        "turns_explained": found.explained,
    }
    if steps_used is None:
        note = f"the gyro was not used: {found.reason}"
        logger.warning(note)
        return content, [note]
    during = (
        None if readout is None or readout.lenses.readout_motion is None else bool(readout.by_gyro)
    )
    content |= {"steps_used": steps_used, "during_readout": during}
    bias = ", ".join(f"{value:.3g}" for value in np.rad2deg(found.sensor.bias))
    notes = [
        f"the gyro agrees with {100 * steps_used:.0f} % of the steps between frames (sigma "
        f"{np.rad2deg(found.noise):.2g} degrees); its clock is {found.clock.offset:.4f} s ahead "
        f"(sigma {found.offset_sigma:.1g}), its bias is {bias} degrees per second, and the sigma "
        f"of its axes is {np.rad2deg(found.axes_sigma):.2g} degrees"
    ]
    if during is not None:
        source = "the gyro" if during else "images, which contradict the gyro"
        notes.append(f"rotations during the readout come from {source}")
    return content, notes
