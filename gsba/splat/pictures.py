"""Pictures of a splat: views of a rig, and panoramas."""

from collections.abc import Iterable

import numpy as np

from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import erp_directions
from gsba.camera.views import View, rig_views
from gsba.splat.backend import Backend
from gsba.splat.camera import rig_cameras
from gsba.splat.gaussians import Gaussians
from gsba.types import FACES


def render_views(
    gaussians: Gaussians,
    world_T_rig: np.ndarray,
    views: Iterable[View],
    near: float,
    backend: Backend,
) -> list[np.ndarray]:
    """Each view of a rig, (height, width, 3) uint8 RGB."""
    renderings = backend.render(gaussians, rig_cameras(world_T_rig, views), None, near)
    return [(np.clip(one.color, 0, 1) * 255 + 0.5).astype(np.uint8) for one in renderings]


def render_panorama(
    gaussians: Gaussians, world_T_rig: np.ndarray, width: int, near: float, backend: Backend
) -> np.ndarray:
    """An equirectangular image (width / 2, width, 3) uint8 RGB as seen from the rig's centre,
    sampled from wider faces."""
    import cv2

    hfov = np.deg2rad(94.0)  # of the faces that a panorama is sampled from
    rig = CubeRig(round(width / np.pi * np.tan(hfov / 2)), hfov)  # as dense as the equator
    faces = render_views(gaussians, world_T_rig, rig_views(rig), near, backend)
    height = width // 2
    bearings = erp_directions(width)
    owners = owner_faces(bearings)
    at = (rig.project(bearings, owners) - 0.5).astype(np.float32)
    image = np.empty((height, width, 3), np.uint8)
    for face in range(len(FACES)):
        sampled = cv2.remap(faces[face], at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        image[owners == face] = sampled[owners == face]
    return image
