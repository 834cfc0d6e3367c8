"""What was found of a gyro that rode along, for report.json, and what to note of it."""

import logging
from typing import Any

import numpy as np

from gsba.bundle.readout import CameraEstimate
from gsba.imu.alignment import Alignment
from gsba.types import GyroConstraints

logger = logging.getLogger(__name__)

_LOST = 3.0  # standard deviations beyond which a step of the gyro has next to no say


def of_gyro(
    found: Alignment,
    turning: GyroConstraints | None,
    readout: CameraEstimate | None,
    world_T_rigs: np.ndarray,
) -> tuple[dict[str, Any], list[str]]:
    """Clock, bias and axes of a gyro, and how much of what it says was used.

    Args:
        found: how it belongs to the frames.
        turning: what it says of them; None = it was not believed.
        readout: how frames are read; None = at one instant.
        world_T_rigs: (F, 4, 4) refined poses.
    """
    said: dict[str, Any] = {
        "taken": turning is not None,
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
    if turning is None:
        note = f"the gyro was left alone: {found.reason}"
        logger.warning(note)
        return said, [note]
    steps = _steps_used(turning, world_T_rigs)
    during = (
        None if readout is None or readout.lenses.readout_motion is None else bool(readout.by_gyro)
    )
    said |= {"steps_used": steps, "during_readout": during}
    bias = ", ".join(f"{value:.3g}" for value in np.rad2deg(found.sensor.bias))
    notes = [
        f"the gyro has a say on {100 * steps:.0f} % of the steps between frames, each known to "
        f"{np.rad2deg(found.noise):.2g} degrees; its clock is {found.clock.offset:.4f} s ahead "
        f"(sigma {found.offset_sigma:.1g}), its bias {bias} degrees per second, "
        f"its axes are known to {np.rad2deg(found.axes_sigma):.2g} degrees"
    ]
    if during is not None:
        how = "as the gyro says" if during else "otherwise than the gyro says, and by images alone"
        notes.append(f"frames turn while they are read {how}")
    return said, notes


def _steps_used(turning: GyroConstraints, world_T_rigs: np.ndarray) -> float:
    """Part of all steps about which refined poses agree with the gyro."""
    from scipy.spatial.transform import Rotation

    rotations = world_T_rigs[:, :3, :3]
    found = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    off = (found.inv() * Rotation.from_rotvec(turning.steps)).as_rotvec()
    near = np.linalg.norm(off, axis=1) < _LOST * np.sqrt(3) * turning.step_sigmas
    return float(np.mean(near & np.isfinite(turning.step_sigmas)))
