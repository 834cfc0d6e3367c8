"""Rendering by a 360-degree camera: two lenses with a rolling shutter, stitched at infinity."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsba.camera.sphere import erp_directions
from gsba.geometry import pose
from gsba.types import Trajectory

if TYPE_CHECKING:
    from gsba.demo.raycast import Scene
    from gsba.demo.render import Eye

SWEEP = (-1.0, 0.0)  # row direction of both sensors, rig's x and y: they are mounted sideways


@dataclass(frozen=True, slots=True)
class TwoLenses:
    """Two fisheyes back to back along the rig's z, with values of an Insta360 X5.

    The gallery's unit is a metre: its ceiling is 3.8 units high, and the walk covers 1.3 units a
    second.
    """

    baseline: float = 0.032  # units between the lenses' centres
    readout_s: float = 0.012  # from the first row to the last one
    gains: tuple[float, float] = (1.03, 0.97)  # exposure of the front and of the back lens
    band_deg: float = 4.0  # from the seam: within it both lenses' images are blended
    half_fov_deg: float = 100.0  # from a lens's axis to the first and to the last row
    bend: tuple[float, float] = (-0.025, 0.0018)  # a point at angle a is a + bend[0] a^3 +
    # bend[1] a^5 from the image's middle, up to scale (Kannala-Brandt)

    def write(self, path: Path) -> None:
        """Write a calibration like that of a camera's maker, as JSON."""
        lenses = {}
        for name, side, turn in (("front", 1.0, np.eye(3)), ("back", -1.0, np.diag([-1.0, 1, -1]))):
            rig_T_lens = np.eye(4)
            # Rows are read along a lens's y, which is the direction SWEEP.
            rig_T_lens[:3, :3] = turn @ np.array([[0, -side, 0], [side, 0, 0], [0, 0, 1]])
            rig_T_lens[2, 3] = side * self.baseline / 2
            lenses[name] = {"rig_T_lens": rig_T_lens.tolist(), "k": list(self.bend)}
        content = {
            "model": "kannala-brandt: r = f (th + k1 th^3 + k2 th^5), rows along y",
            "half_fov_deg": self.half_fov_deg,
            "readout_s": self.readout_s,
            "stitch_radius": None,
            "seam_band_deg": self.band_deg,
            "lenses": lenses,
        }
        path.write_text(json.dumps(content, indent=1) + "\n")


def render_stitched(
    scene: "Scene", world_T_rigs: np.ndarray, camera: TwoLenses, width: int, height: int
) -> np.ndarray:
    """Equirectangular image stitched from both lenses, each in the half that it faces.

    Args:
        world_T_rigs: (K, 4, 4) float64, poses from the first row to the last one; the rig's centre
            is in the middle between the lenses.
        width, height: pixels, width = 2 height.

    Returns:
        (height, width, 3) float32, RGB, 0..255 times the gains, black for rays that hit nothing.
    """
    from gsba.demo.render import render_eye

    band = np.radians(camera.band_deg)
    front, back = (
        gain * render_eye(scene, _eye(world_T_rigs, camera, side), width, height)
        for side, gain in zip((1.0, -1.0), camera.gains, strict=True)
    )
    ahead = erp_directions(width)[..., 2]
    share = np.clip(0.5 + np.arcsin(np.clip(ahead, -1, 1)) / (2 * band), 0, 1)
    return back + share[..., None].astype(np.float32) * (front - back)


def _eye(world_T_rigs: np.ndarray, camera: TwoLenses, side: float) -> "Eye":
    """Front lens (side 1) or back lens (-1)."""
    from gsba.demo.render import Eye

    world_T_eyes = world_T_rigs[:, :3].copy()
    world_T_eyes[:, :, 3] += side * camera.baseline / 2 * world_T_rigs[:, :3, 2]
    return Eye(
        world_T_eyes,
        side,
        SWEEP,
        float(np.radians(camera.half_fov_deg)),
        camera.bend,
        -float(np.sin(np.radians(camera.band_deg))),
    )


STEPS_HZ = 1.9  # steps per second; the body sways once in two steps
KNOTS = 17  # poses during a readout; motion between them is linear
# Amplitude of the camera's swing at each step (vertical, pitch) and over two steps (lateral).
SWING_UNITS = (0.010, 0.018, 0.010)  # along the rig's x, y, z
SWING_DEG = (1.2, 1.0, 1.2)  # about the rig's x, y, z
_SWING_RATES = 2 * np.pi * STEPS_HZ * np.array([0.5, 1.0, 0.5, 1.0, 0.5, 0.5])  # rad/s


def poses_during(truth: Trajectory, readout_s: float, seed: int) -> np.ndarray:
    """Poses of the rig from the first to the last row of each frame.

    The path is smooth, and the frames' poses are those in the middle of the readout. The gait is
    added with a random phase, relative to its value in the middle of the readout.

    Args:
        truth: F poses, at least 3.
        readout_s: readout time from the first row to the last one, seconds.

    Returns:
        (F, KNOTS, 4, 4) float64, evenly spaced in time; (F, 1, 4, 4) for a readout time of 0.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if readout_s == 0:
        return truth.world_T_rigs[:, None]
    after = readout_s * np.linspace(-0.5, 0.5, KNOTS)
    times = truth.timestamps[:, None] + after
    between = CubicSpline(truth.timestamps, truth.world_T_rigs[:, :3, 3])
    orientations = Rotation.from_matrix(truth.world_T_rigs[:, :3, :3])
    turned = RotationSpline(truth.timestamps, orientations)(times.ravel())
    phases = np.random.default_rng([seed, 2]).uniform(0, 2 * np.pi, 6)
    swing = np.concatenate([SWING_UNITS, np.radians(SWING_DEG)])
    at = swing * np.sin(times[..., None] * _SWING_RATES + phases)
    at -= swing * np.sin(truth.timestamps[:, None, None] * _SWING_RATES + phases)
    rotations = turned * Rotation.from_rotvec(at[..., 3:].reshape(-1, 3))
    moved = turned.apply(at[..., :3].reshape(-1, 3)).reshape(*times.shape, 3)
    positions = between(times) + moved
    return pose(rotations.as_matrix().reshape(*times.shape, 3, 3), positions)
