"""Pictures of two fisheyes that see a sphere of smooth colours, and what these are."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from pixels import pixel_centres
from scipy.spatial.transform import Rotation

from gsba.camera.fisheye import Pair, unproject
from gsba.geometry import inverse, pose
from gsba.types import Fisheye

HALF_FOV = np.deg2rad(100.0)
BEHIND = np.diag([-1.0, 1, -1])  # rig_R_lens of an upright back lens


def turned(lens: Fisheye, rig_R_lens: np.ndarray) -> Fisheye:
    """The lens with another rotation (3, 3)."""
    a, b, c = Rotation.from_matrix(rig_R_lens).as_rotvec()
    return replace(lens, rotation=(float(a), float(b), float(c)))


def made_pair(side: int = 240) -> Pair:
    """Two unlike lenses that bend, lie beside their pictures' middles and are a little askew."""
    front = Fisheye(
        side,
        side,
        0.27 * side,
        (0.506 * side, 0.491 * side),
        (-0.03, 0.004, -0.0006, 0.00004),
        (0.01, -0.02, 1.5),
        (0.001, -0.0005, 0.015),
    )
    back = replace(front, focal=0.272 * side, principal=(0.495 * side, 0.503 * side))
    back = turned(back, BEHIND @ Rotation.from_rotvec([0.015, 0.01, -1.6]).as_matrix())
    return front, replace(back, centre=(-0.001, 0.0005, -0.015))


def colours(directions: np.ndarray) -> np.ndarray:
    """RGB (..., 3), 60 to 250, of directions (..., 3)."""
    axes = Rotation.from_rotvec([0.3, -0.7, 0.5]).as_matrix()
    u, v, w = np.moveaxis(directions @ axes, -1, 0)
    waves = np.sin(5 * u + 2 * v), np.cos(4 * v - 3 * w), np.sin(6 * w + u * v)
    return 155 + 95 * np.stack(waves, axis=-1)


@lru_cache(maxsize=8)
def _directions(lens: Fisheye) -> np.ndarray:
    """Directions (h, w, 3) of the pixels of a lens, which takes many pictures."""
    pixels = pixel_centres(lens.width, lens.height)
    return unproject(lens, pixels)


@lru_cache(maxsize=32)
def picture(lens: Fisheye, seen=colours, half_fov: float = HALF_FOV) -> np.ndarray:
    """Picture (h, w, 3) uint8 RGB of a lens, black beyond its circle; cached: not to be changed."""
    directions = _directions(lens)
    axis = Rotation.from_rotvec(lens.rotation).as_matrix()[:, 2]
    within = directions @ axis > np.cos(half_fov)
    shown = np.where(within[..., None], np.rint(seen(directions)), 0).astype(np.uint8)
    shown.flags.writeable = False
    return shown


def write(path: Path, rgb: np.ndarray) -> Path:
    """An image file of RGB (h, w, 3) uint8."""
    path.parent.mkdir(parents=True, exist_ok=True)
    how = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix == ".jpg" else []
    assert cv2.imwrite(str(path), rgb[..., ::-1], how)
    return path


def back_from_front(pair: Pair) -> np.ndarray:
    """back_T_front (4, 4) of two lenses."""
    front, back = (
        pose(Rotation.from_rotvec(lens.rotation).as_matrix(), np.array(lens.centre))
        for lens in pair
    )
    return inverse(back) @ front
