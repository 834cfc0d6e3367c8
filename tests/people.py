"""Synthetic people who move in front of the camera, with exact masks.

They are upright ellipsoids with striped textures that move around the rig, and are ray-traced.
"""

from dataclasses import dataclass

import numpy as np

from gsba.camera.sphere import erp_directions


@dataclass(frozen=True, slots=True)
class Person:
    """Positions, shape and texture of one person."""

    positions_world: np.ndarray  # (F, 3) float64, middle of the body in each frame
    radii: tuple[float, float]  # of the body across and along its axis, world units
    up_world: np.ndarray  # (3,) float64, unit
    clothes: np.ndarray  # (H, W, 3) float32 RGB, wrapped around the body


def make_people(
    world_T_rigs: np.ndarray, num: int, height: float, up_world: np.ndarray, seed: int = 0
) -> list[Person]:
    """People who stay near the camera, each on its own path.

    Args:
        world_T_rigs: (F, 4, 4) true poses.
        num: number of people.
        height: height of a person, and about its distance from the camera, world units.
        up_world: (3,) unit.
        seed: seed of their paths and textures.
    """
    rng = np.random.default_rng(seed)
    num_frames, up = len(world_T_rigs), np.asarray(up_world, dtype=np.float64)
    axes = np.linalg.svd(up[None])[2][1:]  # spans the floor
    people = []
    for k in range(num):
        turn = rng.choice([-1, 1]) * rng.uniform(0.25, 0.6) * np.arange(num_frames)
        angle = 2 * np.pi * k / num + rng.uniform(0, 1) + turn
        angle += 0.4 * np.sin(rng.uniform(0.5, 1.1) * np.arange(num_frames) + rng.uniform(0, 6))
        swing = np.sin(rng.uniform(0.3, 0.9) * np.arange(num_frames) + rng.uniform(0, 6))
        away = height * (1.15 + 0.25 * swing)
        around = np.cos(angle)[:, None] * axes[0] + np.sin(angle)[:, None] * axes[1]
        positions = world_T_rigs[:, :3, 3] + away[:, None] * around + 0.05 * height * up
        people.append(Person(positions, (0.21 * height, 0.5 * height), up, _clothes(rng)))
    return people


def paste_people(
    image: np.ndarray, world_T_rig: np.ndarray, people: list[Person], frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Panorama with people rendered in front of it.

    Args:
        image: (H, 2H, 3) uint8 RGB.
        world_T_rig: (4, 4) its true pose.
        people: see `make_people`.
        frame: row of their positions.

    Returns:
        The panorama, and the mask of people, (H, 2H) bool.
    """
    import cv2

    rays = erp_directions(image.shape[1]) @ world_T_rig[:3, :3].T
    out, nearest = image.copy(), np.full(image.shape[:2], np.inf)
    for person in people:
        offset = person.positions_world[frame] - world_T_rig[:3, 3]
        size = person.radii[1] / np.linalg.norm(offset)
        around = rays @ (offset / np.linalg.norm(offset)) > np.sqrt(max(1 - size**2, 0.0))
        distance, at = _hit(person, -offset, rays[around])
        seen = np.flatnonzero(distance < nearest[around])
        if len(seen) == 0:
            continue
        at = (np.array(person.clothes.shape[:2]) - 1)[:, None] * at[:, seen]
        maps = at[1][None].astype(np.float32), at[0][None].astype(np.float32)
        spots = np.flatnonzero(around)[seen]
        nearest.ravel()[spots] = distance[seen]
        out.reshape(-1, 3)[spots] = cv2.remap(person.clothes, *maps, cv2.INTER_LINEAR)[0]
    return out, np.isfinite(nearest)


def _hit(person: Person, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) to the body along rays (N, 3), inf = not hit, and texture coordinates (2, N).

    The rays' origin (3,), outside of the body, is relative to the middle of the body.
    """
    across, along = person.radii
    up = person.up_world
    squeeze = np.eye(3) / across + np.outer(up, up) * (1 / along - 1 / across)
    origin, directions = origin @ squeeze, rays @ squeeze
    a = np.einsum("ni,ni->n", directions, directions)
    b = directions @ origin
    inside = b * b - a * (origin @ origin - 1)
    distance = (-b - np.sqrt(np.maximum(inside, 0))) / a
    spots = origin + distance[:, None] * directions
    axes = np.linalg.svd(up[None])[2][1:]
    turn = np.arctan2(spots @ axes[1], spots @ axes[0]) / (2 * np.pi) + 0.5
    at = np.clip(np.stack([0.5 - 0.5 * spots @ up, turn]), 0, 1)
    return np.where((inside > 0) & (distance > 0), distance, np.inf), at


def _clothes(rng: np.random.Generator) -> np.ndarray:
    """Texture of head, top and trousers with a pattern, (128, 256, 3) float32 RGB."""
    import cv2

    skin, top, legs = (np.array(c) for c in ((205, 160, 130), *rng.uniform(25, 190, (2, 3))))
    image = np.empty((128, 256, 3), np.float32)
    image[:24], image[24:72], image[72:] = skin, top, legs
    image[24:72] *= 1 + 0.3 * np.sign(np.sin(np.arange(256) * rng.uniform(0.1, 0.5)))[:, None]
    blots = cv2.GaussianBlur(rng.normal(size=(128, 256)).astype(np.float32), (0, 0), 3)
    image *= (1 + 0.25 * blots / blots.std())[..., None]
    return np.clip(image, 5, 250)
