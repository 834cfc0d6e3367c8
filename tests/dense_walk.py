"""A dense walk through the gallery, rendered small."""

from dataclasses import dataclass

import cv2
import numpy as np
from one_gallery import gallery

from gsba.camera.sphere import around_sphere, erp_directions, erp_from_bearings
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses

WIDTH = 512
NUM_FRAMES = 34
STEPS_OF_WALK = 260  # frames of the whole walk: 0.1 units apart


@dataclass(frozen=True)
class RenderedWalk:
    """Small grey panoramas and where they were taken."""

    frames: list[np.ndarray]  # (h, 2h) uint8
    world_T_rigs: np.ndarray  # (F, 4, 4)

    def at(self, order: list[int]) -> "RenderedWalk":
        """Frames in another order, each with noise of its own."""
        rng = np.random.default_rng(1)
        frames = [self.frames[i] + rng.normal(0, 2, self.frames[i].shape) for i in order]
        grey = [np.clip(frame, 0, 255).astype(np.uint8) for frame in frames]
        return RenderedWalk(grey, self.world_T_rigs[order])

    def turned(self, rotations: np.ndarray) -> "RenderedWalk":
        """Each frame by a camera turned besides, rig_R_turned (F, 3, 3)."""
        frames = [turn(frame, r) for frame, r in zip(self.frames, rotations, strict=True)]
        poses = self.world_T_rigs.copy()
        poses[:, :3, :3] = poses[:, :3, :3] @ rotations
        return RenderedWalk(frames, poses)


def turn(grey: np.ndarray, rig_R_turned: np.ndarray) -> np.ndarray:
    """What a turned camera sees of a panorama (h, 2h) uint8."""
    height, width = grey.shape
    rays = erp_directions(width) @ rig_R_turned.T
    u, v = np.moveaxis(erp_from_bearings(rays, width, height) + 1.5, -1, 0).astype(np.float32)
    return cv2.remap(around_sphere(grey, 2), u, v, cv2.INTER_LINEAR)


def render_walk() -> RenderedWalk:
    scene, truth = gallery(), walk_poses("open", "locked", STEPS_OF_WALK, 0)
    poses = truth.world_T_rigs[:NUM_FRAMES].copy()
    frames = []
    for pose in poses:
        picture = render_erp(scene, pose, WIDTH, WIDTH // 2)
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        frames.append(np.clip(grey, 0, 255).astype(np.uint8))
    return RenderedWalk(frames, poses)
