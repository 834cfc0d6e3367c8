"""Stills of a tour through one room with painted walls, far apart, and their true poses."""

from functools import cache

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsba.camera.sphere import erp_directions
from gsba.config import FeatureSettings
from gsba.geometry import inverse, pose
from gsba.odometry import tour_steps
from gsba.odometry.tour_steps import Step, TourFrame, frame_of, step_at

_HALF = np.array([3.0, 1.3, 2.5])  # of the room's sides, x, y, z
_WALL = 512  # pixels of a wall's side
WIDTH = 1024
POSITIONS = np.array([[-1.6, 0.1, -1.2], [-0.6, 0.0, -0.3], [0.5, 0.1, 0.3], [1.3, 0.0, 1.2]])


def true_poses() -> np.ndarray:
    """World poses (4, 4, 4) of the stills."""
    turns = Rotation.from_rotvec(np.deg2rad([[0, turn, 0] for turn in (0, 25, 10, 60)])).as_matrix()
    return pose(turns, POSITIONS)


@cache
def picture(n: int, room: int = 0) -> np.ndarray:
    """Panorama (h, 2h) uint8 of a still, not to be changed; rooms differ in their walls' paint."""
    return _seen(_walls(room), true_poses()[n])


@cache
def still(n: int, room: int = 0) -> TourFrame:
    """A still with as few keypoints as these rooms need."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tour_steps, "_FEATURES", FeatureSettings(max_per_face=150))
        patch.setattr(tour_steps, "_NUM_KEYS", 200)
        return frame_of(picture(n, room), None)


def frames() -> list[TourFrame]:
    """All stills of the first room."""
    return [still(n) for n in range(len(POSITIONS))]


@cache
def true_step(first: int, room: int = 0) -> Step:
    """The step from a still to the next one at its true pose."""
    one, other, poses = still(first, room), still(first + 1, room), true_poses()
    return step_at(one, other, inverse(poses[first + 1]) @ poses[first])


@cache
def _walls(room: int) -> list[np.ndarray]:
    return [_wall(np.random.default_rng(6 * room + n)) for n in range(6)]


def _wall(rng: np.random.Generator) -> np.ndarray:
    """Noise of several scales, which nowhere repeats."""
    noise = [
        cv2.resize(rng.normal(size=(_WALL // size, _WALL // size)), (_WALL, _WALL))
        for size in (4, 8, 16, 64)
    ]
    total = cv2.GaussianBlur(sum(noise), (0, 0), 1.0)
    return np.clip(128 + 40 * total, 0, 255).astype(np.float32)


def _seen(walls: list[np.ndarray], world_T_rig: np.ndarray) -> np.ndarray:
    rays = erp_directions(WIDTH) @ world_T_rig[:3, :3].T
    with np.errstate(divide="ignore"):
        away = (np.sign(rays) * _HALF - world_T_rig[:3, 3]) / rays
    axis = away.argmin(axis=-1)
    places = world_T_rig[:3, 3] + rays * away.min(axis=-1, keepdims=True)
    out = np.zeros(axis.shape, np.float32)
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        u, v = ((places[..., d] / _HALF[d] + 1) / 2 * (_WALL - 1) for d in (b, c))
        for side in range(2):
            chosen = (axis == a) & ((rays[..., a] > 0) == (side == 1))
            wall = cv2.remap(
                walls[2 * a + side], u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR
            )
            out[chosen] = wall[chosen]
    return np.rint(out).astype(np.uint8)
