"""Frames inside a textured ball: every grey value, depth and normal in closed form."""

from dataclasses import dataclass

import gtsam
import numpy as np
from synthetic import unit

from factors._photometric_kernels import sample
from factors.compiled import kernel_and_part
from factors.patch_windows import PAD, PatchPixels, PatchTable, coded, patch_axes, pixel_grid
from factors.sphere_image import SphereImage
from gsba.camera.sphere import erp_directions

RADIUS = 4.0


class Texture:
    """Sum of plane waves over the ball: smooth, with detail down to a few pixels."""

    def __init__(self, rng: np.random.Generator, finest: float = 40.0) -> None:
        self.waves = unit(rng.normal(size=(60, 3))) * rng.uniform(5, finest, (60, 1))
        self.phases = rng.uniform(0, 6, 60)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Grey values (...,) at points (..., 3) of the ball."""
        rows, sums = points.reshape(-1, 3), np.empty(points.shape[:-1]).reshape(-1)
        for first in range(0, len(rows), 512):  # the waves of so many points fit in a CPU's cache
            waves = rows[first : first + 512] / RADIUS @ self.waves.T
            angles = (waves + self.phases).astype(np.float32)  # its sines take a fifth of the time
            np.sin(angles, out=angles).sum(axis=-1, out=sums[first : first + 512])
        return 127 + 8 * sums.reshape(points.shape[:-1])


def planes_from(
    bearings_rig: np.ndarray, distances: np.ndarray, normals_rig: np.ndarray | None = None
) -> np.ndarray:
    """Inverse-depth planes (P, 3) of patches at distances (P,), map units.

    Along bearing + x e1 + y e2 the plane is at 1 / (theta0 + x theta1 + y theta2) times the length
    of that vector.

    Args:
        bearings_rig: (P, 3) unit.
        distances: (P,) positive.
        normals_rig: (P, 3) of any length, either sign, not orthogonal to the bearing; None = planes
            orthogonal to the bearings.
    """
    inverse = 1.0 / np.asarray(distances, dtype=np.float64)
    planes = np.zeros((len(inverse), 3))
    planes[:, 0] = inverse
    if normals_rig is not None:
        along = np.einsum("pki,pi->pk", patch_axes(bearings_rig), normals_rig)
        planes[:, 1:] = inverse[:, None] * along[:, 1:] / along[:, :1]
    return planes


@kernel_and_part()[0]
def _sample_many(pixels, window, width, directions, values, gradients):
    """Values (N,) and gradients (N, 3) along directions (N, 3) in one window; NaN outside it."""
    for i in range(len(directions)):
        inside, value, x, y, z = sample(
            pixels, 0, window[0], window[1], window[2], window[3], width,
            directions[i, 0], directions[i, 1], directions[i, 2],
        )  # fmt: skip
        values[i] = value if inside else np.nan
        gradients[i, 0], gradients[i, 1], gradients[i, 2] = x, y, z


class CodedImage:
    """A whole sphere image as windows hold it, in double precision: what the block samples."""

    def __init__(self, image: SphereImage) -> None:
        codes = coded(image)
        self.codes, self.width = codes.ravel(), image.coefficients.shape[1]
        self.window = np.array([-PAD, -PAD, codes.shape[1], codes.shape[0]], dtype=np.int32)

    def sample(self, vectors_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (...) and gradients (..., 3) along vectors (..., 3); NaN where there is none."""
        flat = np.ascontiguousarray(vectors_rig, dtype=np.float64).reshape(-1, 3)
        values, gradients = np.empty(len(flat)), np.empty((len(flat), 3))
        _sample_many(self.codes, self.window, self.width, flat, values, gradients)
        return values.reshape(vectors_rig.shape[:-1]), gradients.reshape(vectors_rig.shape)


@dataclass
class BallWorld:
    """Frames, their images and patches that are exact in depth and nearly flat."""

    world_T_rigs: np.ndarray
    images: list[SphereImage]
    pixels: PatchPixels
    grey: list[np.ndarray]

    def values(self, world_T_rigs: np.ndarray | None = None) -> gtsam.Values:
        values = gtsam.Values()
        for f, pose in enumerate(self.world_T_rigs if world_T_rigs is None else world_T_rigs):
            values.insert(f, gtsam.Pose3(pose))
        return values

    def of(
        self, table: PatchTable, images: dict[int, np.ndarray] | None = None, margin: float = 6.0
    ) -> "BallWorld":
        """The world with these patches, cut from its images or, of some frames, from others."""
        shown = list(self.images)
        for f, grey in (images or {}).items():
            shown[f] = SphereImage.of(grey)
        pixels = PatchPixels(table, self.world_T_rigs, self.pixels.width, margin)
        for f, image in enumerate(shown):
            pixels.take(f, image)
        return BallWorld(self.world_T_rigs, shown, pixels, self.grey)


def distances_to_ball(world_T_rig: np.ndarray, bearings: np.ndarray) -> np.ndarray:
    """Distances (...,) along bearings (..., 3) of a rig inside the ball."""
    rays, centre = bearings @ world_T_rig[:3, :3].T, world_T_rig[:3, 3]
    along = rays @ centre
    return -along + np.sqrt(along**2 + RADIUS**2 - centre @ centre)


def render(world_T_rig: np.ndarray, texture: Texture, width: int) -> np.ndarray:
    """Grey panorama (width / 2, width) of the ball from inside."""
    bearings = erp_directions(width)
    points = distances_to_ball(world_T_rig, bearings)[..., None] * bearings
    return texture(points @ world_T_rig[:3, :3].T + world_T_rig[:3, 3])


def poses(rng: np.random.Generator, num: int, spread: float = 0.3) -> np.ndarray:
    """Random poses (num, 4, 4) near the centre of the ball."""
    return np.array(
        [
            gtsam.Pose3(
                gtsam.Rot3.Ypr(*(0.2 * rng.normal(size=3))), spread * rng.normal(size=3)
            ).matrix()
            for _ in range(num)
        ]
    )


def make_ball_world(
    seed: int = 0,
    num_frames: int = 4,
    num_patches: int = 120,
    width: int = 512,
    size: int = 9,
    gains: np.ndarray | None = None,
    offsets: np.ndarray | None = None,
    spread: float = 0.3,
) -> BallWorld:
    """Patches at random bearings of all frames, each seen in all others.

    Args:
        gains, offsets: (F,) of each frame's grey values.
        spread: of the frames' positions, units.
    """
    rng = np.random.default_rng(seed)
    world_T_rigs, texture = poses(rng, num_frames, spread), Texture(rng, 40.0 * width / 512)
    gains = np.ones(num_frames) if gains is None else gains
    offsets = np.zeros(num_frames) if offsets is None else offsets
    grey = [
        gain * render(pose, texture, width) + offset
        for pose, gain, offset in zip(world_T_rigs, gains, offsets, strict=True)
    ]
    images = [SphereImage.of(image) for image in grey]
    hosts = np.sort(rng.integers(0, num_frames, num_patches))
    bearings = unit(rng.normal(size=(num_patches, 3)))
    table = table_of(world_T_rigs, hosts, bearings, width, size)
    pixels = PatchPixels(table, world_T_rigs, width)
    for f, image in enumerate(images):
        pixels.take(f, image)
    return BallWorld(world_T_rigs, images, pixels, grey)


def table_of(
    world_T_rigs: np.ndarray, hosts: np.ndarray, bearings: np.ndarray, width: int, size: int
) -> PatchTable:
    """Patches with exact planes, seen in all other frames."""
    num_frames = len(world_T_rigs)
    distances = np.array(
        [distances_to_ball(world_T_rigs[h], b) for h, b in zip(hosts, bearings, strict=True)]
    )
    rotations = world_T_rigs[hosts, :3, :3]
    points = np.einsum("pij,pj->pi", rotations, distances[:, None] * bearings)
    normals = np.einsum("pji,pj->pi", rotations, points + world_T_rigs[hosts, :3, 3])
    planes = planes_from(bearings, distances, normals)
    targets = [[f for f in range(num_frames) if f != host] for host in hosts]
    return PatchTable(
        hosts,
        bearings,
        planes,
        planes[:, :1] * [[0.5, 0.5, 0.5]],
        np.arange(len(hosts) + 1) * (num_frames - 1),
        np.array(targets, dtype=np.int64).ravel(),
        pixel_grid(size, 2 * np.pi / width),
    )
