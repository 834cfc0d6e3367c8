"""Velocities of the camera in each frame, in the keys of transforms.json of SpectacularAI's
3dgs-deblur (Seiskari et al., ECCV 2024): in the camera's OpenGL axes, per second. A row is taken at
(its height in the picture - 1/2) rolling_shutter_time after the pose, and blurred over
exposure_time."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsba.camera.cameras import Cameras
from gsba.geometry import CV_R_GL, inverse
from gsba.types import FrameSet, Reconstruction

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Shutter:
    """Times of a picture's exposure."""

    readout_s: float | None = None  # from the first row to the last one; None = not known
    exposure_s: float | None = None  # of each row; None = not known


UNKNOWN = Shutter()


def rig_velocities(
    reconstruction: Reconstruction, frames: FrameSet, cameras: Cameras, shutter: Shutter
) -> np.ndarray | None:
    """Velocities (F, 6), [rotation rad/s, translation map units/s], in the axes of exported rigs.

    They are the motions during the readout where these are known, of one camera; else the steps
    between neighbouring frames where all are at most a quarter of a second apart. None = neither.

    Args:
        reconstruction: poses of the exported rigs, which have the lenses' axes.
    """
    lenses = cameras.lenses[0]
    if len(cameras.lenses) == 1 and lenses.readout_motion is not None and shutter.readout_s:
        parts = lenses.readout_motion.reshape(-1, 2, 3) / shutter.readout_s
        parts = parts if lenses.axes is None else parts @ lenses.axes
        return parts.reshape(-1, 6)
    steps = np.diff(frames.timestamps)
    # seconds: poses further apart do not tell how fast the camera moves in between
    if len(steps) < 2 or steps.max() > 0.25:
        if shutter.exposure_s is not None:
            logger.warning(
                "the exposure is not written: how the camera moves meanwhile is known by a "
                "readout that the run found (in --images lenses and fisheye), or by frames at most "
                "a quarter of a second apart"
            )
        return None
    from scipy.spatial.transform import Rotation

    poses, times = reconstruction.world_T_rigs, frames.timestamps
    last = np.arange(len(poses))
    before, after = np.maximum(last - 1, 0), np.minimum(last + 1, len(poses) - 1)
    moved = inverse(poses[before]) @ poses[after]
    turns = Rotation.from_matrix(moved[:, :3, :3]).as_rotvec()
    moves = poses[after, :3, 3] - poses[before, :3, 3]
    moves = np.einsum("fji,fj->fi", poses[:, :3, :3], moves)
    return np.hstack([turns, moves]) / (times[after] - times[before])[:, None]


def velocity_keys(rig_velocity: np.ndarray, rig_T_camera: np.ndarray) -> dict[str, Any]:
    """Entries of a frame in transforms.json.

    Args:
        rig_velocity: (6,) of the rig, see `rig_velocities`.
        rig_T_camera: (4, 4) of a camera with axes x right, y down, z forward.
    """
    camera_R_rig = (rig_T_camera[:3, :3] @ CV_R_GL).T
    turn, move = rig_velocity[:3], rig_velocity[3:]
    moved = move + np.cross(turn, rig_T_camera[:3, 3])
    return {
        "camera_linear_velocity": (camera_R_rig @ moved).tolist(),
        "camera_angular_velocity": (camera_R_rig @ turn).tolist(),
    }


def shutter_keys(shutter: Shutter, rolling: bool) -> dict[str, float]:
    """Entries of all frames in transforms.json; faces have no rolling rows."""
    readout_s = (shutter.readout_s or 0.0) if rolling else 0.0
    return {"rolling_shutter_time": readout_s, "exposure_time": shutter.exposure_s or 0.0}
