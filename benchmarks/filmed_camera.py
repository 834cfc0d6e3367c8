"""A 360-degree camera as it films: hands, two rolling-shutter lenses, sensor, processing, codec.

Every effect of `EFFECTS` is switched by its name. Without any, the camera is ideal: one centre, one
instant, grey-value noise of 2 and JPEG of quality 95, as `gsba demo` writes it. Images of the two
lenses are processed on the grid of the panorama, which they are stitched in, or of raw fisheyes
(`RawCamera`). Sensor and processing follow the order of a camera: optics, exposure, noise, mosaic,
denoising in time, tone curve, sharpening, stitching, stabilisation, encoding.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from learned import sampled, turned
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from gsba.camera.calibration import calibration_json
from gsba.camera.fisheye import three, unproject
from gsba.camera.sphere import around_seam, bearings_from_erp, erp_from_bearings
from gsba.demo import pictures
from gsba.demo.mesh import MeshBuilder
from gsba.demo.raycast import Scene, ranges
from gsba.demo.render import EXPOSURE, Eye, render_eye
from gsba.demo.two_lenses import KNOTS, STEPS_HZ, SWEEP, SWING_DEG, SWING_UNITS, TwoLenses
from gsba.demo.walk import JPEG_QUALITY, NOISE, write_depth
from gsba.disk import write_image
from gsba.geometry import pose
from gsba.trajectory.files import write_tum
from gsba.types import Fisheye, Trajectory

HAND_MOTION = Path("../shared/data/real/hand_motion/floor_2_2025-10-28_run_2.txt")
EFFECTS = {
    "lenses": "lenses 32 mm apart, stitched at infinity, whatever the depth is",
    "rows": "rows read one after another, 12 ms a frame",
    "blur": "motion during an exposure of 2 to 20 ms, longer where it is dark",
    "noise": "photon and read noise of a small sensor, before processing",
    "mosaic": "Bayer mosaic, demosaiced along edges",
    "denoise": "recursive denoising in time, without motion compensation",
    "sharpen": "unsharp mask: halos of 1 pixel",
    "tone": "S-shaped tone curve with local contrast",
    "colour": "vignetting and a colour of its own for each lens",
    "wander": "automatic exposure and a white balance that wanders",
    "flare": "veiling glare and mirrored ghosts of lamps and windows",
    "people": "two people who walk through, and a television",
    "stabilised": "panoramas turned back to one heading, lenses turn below them",
    "hevc": "HEVC 4:2:0, 8 bit, 0.2 bits a pixel at 30 frames a second",
    "hevc10": "the same at 10 bit",
    "door": "a door leaf that swings open in 15 % of the walk's time",
    "curtain": "a cloth of 2.4 x 3 m that waves all the time",
    "mirror": "a mirror of 2 x 1.2 m on a wall",
    "flow": "lenses 32 mm apart, aligned at the seam by dense optical flow, half by each",
    "vfr": "irregular times of frames, up to 0.2 s off, written to a millisecond",
}
NOT_IN_ALL = "stabilised", "hevc10", "door", "curtain", "mirror", "flow", "vfr"
ALL = frozenset(EFFECTS) - set(NOT_IN_ALL)
BITS_PER_PIXEL = 100e6 / 30 / (5760 * 2880)  # of a 5.7K camera that writes 100 Mb/s
GOP = 30  # frames from one intra-coded frame to the next one
BURST = 3  # frames at 30 fps up to each kept one: history of the denoiser and of the encoder
VIDEO_FPS = 30.0
BLUR_SAMPLES = 5
ELECTRONS, READ_NOISE = 1200.0, 4.0  # signal at radiance 1, standard deviation
SMOOTH_S = 0.5  # standard deviation of the filter that separates hands from the walk
_MAX_RADIANCE = 5.0  # of a saturated pixel
FLOW_BAND_DEG = 10.0  # from the seam: within it lenses are aligned by optical flow
_MARGIN_DEG = 14.0  # each lens is rendered to this angle beyond the seam: filters see no border
# A door, a curtain and a mirror in the gallery of `gsba demo`, lit evenly, without shadows:
DOOR_HINGE, DOOR_SIZE = np.array([-0.75, -2.4, -0.92]), (1.1, 2.4)  # beside the passage, units
DOOR_OPENS, DOOR_DEG = (0.2, 0.35), 100.0  # shares of the walk's time, turn
CURTAIN_CORNER, CURTAIN_SIZE = np.array([-4.5, -3.2, -4.8]), (2.4, 3.0)  # at the wall z = -5
CURTAIN_FACES, CURTAIN_SWING = (24, 6), 0.12  # columns and rows, units at its lower edge
MIRROR_CENTRE, MIRROR_SIZE = np.array([-1.2, -1.5, 4.94]), (2.0, 1.2)  # at the wall z = 5
_DOWN = np.array([0.0, 1.0, 0.0])


class View(NamedTuple):
    """Record of one frame by one lens."""

    facing: float  # 1 front, -1 back
    radiance: np.ndarray  # (H, W, 3) float32, RGB, linear; 0 beyond the lens's part


class Hands:
    """Continuous poses of a walk: its smooth path, with the motion of real hands on it."""

    def __init__(self, walk: Trajectory, seed: int) -> None:
        rng = np.random.default_rng([seed, 7])
        self.walk = walk
        steady = np.concatenate([[-1.0], walk.timestamps, [walk.timestamps[-1] + 1]])
        rows = np.clip(np.arange(-1, len(walk.timestamps) + 1), 0, len(walk.timestamps) - 1)
        turns = Rotation.from_matrix(walk.world_T_rigs[rows, :3, :3])
        self.walked = CubicSpline(walk.timestamps, walk.world_T_rigs[:, :3, 3])
        self._turn = RotationSpline(steady, turns)  # which does not extrapolate
        self.recorded = HAND_MOTION.exists()
        times, turns, shifts = _recorded() if self.recorded else _invented(walk, rng)
        span = walk.timestamps[-1] - walk.timestamps[0] + 2
        start = times[0] + rng.uniform(0, max(times[-1] - times[0] - span, 0))
        self._offset = start + 1 - walk.timestamps[0]
        self._hand_turn = CubicSpline(times, turns)
        self._hand_shift = CubicSpline(times, shifts)

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Poses world_T_rig (N, 4, 4) at times (N,), seconds of the walk."""
        hand = Rotation.from_rotvec(self._hand_turn(times + self._offset))
        rotations = (hand * self._turn(times)).as_matrix()
        return pose(rotations, self.walked(times) + self._hand_shift(times + self._offset))


def _recorded() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (N,), rotation vectors and shifts (N, 3) of recorded hands about their smooth path,
    world of the demo (y down), in seconds, radians and metres."""
    rows = np.loadtxt(HAND_MOTION)
    world_R_hand = Rotation.from_quat(rows[:, 4:])
    width = SMOOTH_S * VIDEO_FPS
    flips = np.sign((rows[1:, 4:] * rows[:-1, 4:]).sum(axis=1))
    continuous = rows[:, 4:] * np.cumprod(np.r_[1, flips])[:, None]
    smooth = Rotation.from_quat(gaussian_filter1d(continuous, width, axis=0))
    turns = (world_R_hand * smooth.inv()).as_rotvec()
    shifts = rows[:, 1:4] - gaussian_filter1d(rows[:, 1:4], width, axis=0)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up -> y down
    return rows[:, 0], turns @ down.T, shifts @ down.T


def _invented(
    walk: Trajectory, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, rotation vectors and shifts of an invented gait, where the recording is absent."""
    times = np.arange(walk.timestamps[0] - 2, walk.timestamps[-1] + 2, 1 / VIDEO_FPS)
    rates = 2 * np.pi * STEPS_HZ * np.array([0.5, 1, 0.5, 1, 0.5, 0.5])
    waves = np.sin(times[:, None] * rates + rng.uniform(0, 2 * np.pi, 6))
    swing = np.concatenate([SWING_UNITS, np.radians(SWING_DEG)])
    return times, (waves * swing)[:, 3:], (waves * swing)[:, :3]


@dataclass(frozen=True)
class Camera:
    """Camera with a set of effects, in a scene."""

    scene: Scene
    hands: Hands
    effects: frozenset[str]
    width: int
    seed: int
    grain: float = NOISE  # grey values, of a camera without the effect `noise`
    rays: int = 1  # rays across a pixel, averaged

    @cached_property
    def bearings(self) -> np.ndarray:
        """Unit rays (H, W, 3) of the panorama's pixels."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.width // 2) + 0.5)
        return bearings_from_erp(np.stack([u, v], axis=-1), self.width, self.width // 2)

    def rays_of(self, facing: float) -> np.ndarray:
        """Unit rays (H, W, 3), rig frame, of the pixels of a lens's picture."""
        return self.bearings

    def projected(self, picture: np.ndarray, facing: float) -> np.ndarray:
        """Picture (H, W, 3) of a lens, of one on a finer panorama's grid."""
        size = self.width, self.width // 2
        return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)

    @cached_property
    def times(self) -> np.ndarray:
        """Times (F,) of the frames, seconds."""
        times = self.hands.walk.timestamps
        if "vfr" not in self.effects:
            return times
        return times + np.random.default_rng([self.seed, 11]).uniform(-0.2, 0.2, len(times))

    def scene_at(self, time: float) -> Scene:
        """The scene, with what moves in it, at a time of the walk."""
        walk = self.hands.walk.timestamps
        passed = time - walk[0]
        return furnished(self.scene, self.effects, passed / (walk[-1] - walk[0]), passed)

    @cached_property
    def metered(self) -> np.ndarray:
        """Mean radiance (F,) of the scene around each frame, relative to the walk's median."""
        small = [
            np.median(_linear(render_eye(self.scene, Eye(T[None, :3]), 128, 64)))
            for T in self.hands.poses(self.times)
        ]
        return np.array(small) / np.median(small)

    def truth(self) -> Trajectory:
        """Poses of the panoramas, in the middle of exposure and readout, at the times written."""
        poses = self.hands.poses(self.times)
        if "stabilised" in self.effects:
            poses[:, :3, :3] = self.heading()
        return Trajectory(np.round(self.times, 3), poses)

    def heading(self) -> np.ndarray:
        """Upright rotation (3, 3) of stabilised panoramas, another one than any frame's."""
        return Rotation.from_rotvec([0, 0.4, 0]).as_matrix()

    def frames(self) -> Iterator[list[np.ndarray]]:
        """Yield each frame's burst of panoramas (H, W, 3), float32 RGB 0..255; the last is kept."""
        rng = np.random.default_rng([self.seed, 3])
        look = _Look(self, rng)
        bursts = BURST if self.effects & {"denoise", "hevc", "hevc10"} else 1
        for f, time in enumerate(self.times):
            look.start_burst()
            burst = []
            for k in range(bursts):
                at = time - (bursts - 1 - k) / VIDEO_FPS
                samples = BLUR_SAMPLES if k == bursts - 1 else 2
                recorded = [self.record(at, side, f, samples) for side in (1.0, -1.0)]
                views = [look.processed(view, f) for view in recorded]
                picture = self.joined(views[0], views[1], at)
                if "noise" not in self.effects:  # that of the ideal camera
                    noise = rng.standard_normal(picture.shape, dtype=np.float32)
                    picture = picture + self.grain * noise
                burst.append(np.clip(picture, 0, 255))
            yield burst

    def record(self, time: float, facing: float, f: int, samples: int) -> View:
        """Radiance that one lens gathers: its rows, exposure, and people in front of it."""
        lens = TwoLenses()
        baseline = lens.baseline if self.effects & {"lenses", "flow"} else 0.0
        after = np.zeros(1)
        if "rows" in self.effects:
            after = lens.readout_s * np.linspace(-0.5, 0.5, KNOTS)
        exposures = np.zeros(1)
        if "blur" in self.effects:
            exposed_s = np.clip(0.010 / self.metered[f], 0.002, 0.020)
            exposures = exposed_s * ((np.arange(samples) + 0.5) / samples - 0.5)
        total = 0.0
        for e in exposures:
            poses = self.hands.poses(time + e + after)
            if "stabilised" in self.effects:  # the gyro turns each row back
                poses[:, :3, :3] = self.hands.poses(np.array([time + e]))[:, :3, :3]
            eyes = poses[:, :3].copy()
            eyes[:, :, 3] += facing * baseline / 2 * poses[:, :3, 2]
            least = -float(np.sin(np.radians(_MARGIN_DEG)))
            eye = Eye(eyes, facing, SWEEP, np.radians(lens.half_fov_deg), lens.bend, least)
            finer = self.rays * self.width
            scene, mirror = self.scene_at(time + e), "mirror" in self.effects
            radiance = _linear(seen(scene, eye, finer, mirror))
            total = total + self.projected(radiance, facing)
        radiance = np.asarray(total / len(exposures), np.float32)
        if "people" in self.effects:
            self._add_people(radiance, facing, time)
        return View(facing, radiance)

    def _add_people(self, radiance: np.ndarray, facing: float, time: float) -> None:
        """Draw two people and a television, seen from the rig's middle at one instant."""
        world_T_rig = self.hands.poses(np.array([time]))[0]
        rays = self.rays_of(facing).reshape(-1, 3) @ world_T_rig[:3, :3].T
        origin, flat, scene = world_T_rig[:3, 3], radiance.reshape(-1, 3), self.scene_at(time)
        walk = self.hands.walk
        for k, (lead, tone) in enumerate(((5.0, (0.5, 0.2, 0.15)), (14.0, (0.12, 0.2, 0.4)))):
            span = walk.timestamps[-1] - walk.timestamps[0]
            met = walk.timestamps[0] + (2 * lead - 0.8 * (time - walk.timestamps[0])) % span
            centre = self.hands.walked(met) + np.array([0.45, 0.65, 0.35])
            distance, at = _ellipsoid(origin, rays, centre, np.array([0.24, 0.85, 0.2]))
            rows = np.flatnonzero(distance > 0)
            free = ranges(scene, origin, rays[rows])
            rows = rows[(free == 0) | (free > distance[rows])]
            stripes = 0.6 + 0.4 * np.sin(40 * at[rows, 1] + 9 * at[rows, 0] + k)
            flat[rows] = stripes[:, None] * np.array(tone, np.float32)
        screen = np.array([6.9, -1.6, 0.0])  # on the east wall of the gallery
        distance = (screen[0] - origin[0]) / np.where(rays[:, 0] > 1e-6, rays[:, 0], np.inf)
        at = origin + distance[:, None] * rays - screen
        rows = np.flatnonzero((distance > 0) & (abs(at[:, 1]) < 0.55) & (abs(at[:, 2]) < 1.0))
        free = ranges(scene, origin, rays[rows])
        rows = rows[(free == 0) | (free > distance[rows] - 0.15)]
        rng = np.random.default_rng([self.seed, round(time * 4)])  # a new shot every 1/4 s
        shot = cv2.resize(rng.uniform(0, 1.5, (9, 16, 3)), (160, 90), interpolation=cv2.INTER_CUBIC)
        y = ((at[rows, 1] + 0.55) / 1.1 * 89).astype(int)
        flat[rows] = shot[y, ((at[rows, 2] + 1) / 2 * 159).astype(int)]

    def joined(self, front: np.ndarray, back: np.ndarray, time: float) -> np.ndarray:
        """Panorama of both lenses, blended at the seam and turned to its heading."""
        flow = "flow" in self.effects
        band = np.radians(FLOW_BAND_DEG if flow else TwoLenses().band_deg)
        share = np.clip(0.5 + np.arcsin(self.bearings[..., 2]) / (2 * band), 0, 1)
        if flow:
            front, back = self._aligned(front, back, share)
        picture = back + share[..., None].astype(np.float32) * (front - back)
        if "stabilised" in self.effects:
            world_R_rig = self.hands.poses(np.array([time]))[0, :3, :3]
            picture = turned(picture, world_R_rig.T @ self.heading(), cv2.INTER_CUBIC)
        return picture

    def _aligned(
        self, front: np.ndarray, back: np.ndarray, share: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Both lenses' pictures, warped to where a lens at `share` of the way to the front one
        sees what they have in common, by optical flow."""
        size = self.width, self.width // 2
        level_R_rig = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix()  # seam on the equator
        padded = [
            around_seam(turned(one, level_R_rig.T), 64).clip(0, 255).astype(np.uint8)
            for one in (front, back)
        ]
        rows = round(size[1] * (90 - _MARGIN_DEG + 1) / 180)
        first, second = (cv2.cvtColor(one, cv2.COLOR_RGB2GRAY)[rows:-rows] for one in padded)
        finder = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        found = finder.calc(first, second, np.zeros((*first.shape, 2), np.float32))
        flow = np.zeros((size[1], self.width, 2), np.float32)
        flow[rows:-rows] = found[:, 64:-64]
        rays = self.bearings @ level_R_rig.T
        shift, pixels = sampled(flow, rays, cv2.INTER_LINEAR), erp_from_bearings(rays, *size)
        warped = []
        for one, part in ((front, share - 1), (back, share)):
            moved = bearings_from_erp(pixels + part[..., None] * shift, *size)
            warped.append(sampled(one, moved @ level_R_rig, cv2.INTER_CUBIC))
        return warped[0], warped[1]


@dataclass(frozen=True)
class RawCamera(Camera):
    """A camera that writes raw fisheye images, side by side: the front lens on the left.

    Lenses are 32 mm apart; nothing is stitched, stabilised or aligned at a seam.
    """

    rays: int = 2

    @cached_property
    def lenses(self) -> dict[float, Fisheye]:
        """Both lenses, by where they face."""
        lens, size = TwoLenses(), self.width // 2
        limit = np.radians(lens.half_fov_deg)
        focal = size / 2 / (limit * (1 + lens.bend[0] * limit**2 + lens.bend[1] * limit**4))
        found = {}
        for facing in (1.0, -1.0):  # rows are read along a lens's y, which is SWEEP
            x, y, z = np.array([0, facing, 0]), np.array([*SWEEP, 0]), np.array([0, 0, facing])
            turn = Rotation.from_matrix(np.stack([x, y, z], axis=1)).as_rotvec()
            middle, bend = (size / 2, size / 2), (*lens.bend, 0.0, 0.0)
            found[facing] = Fisheye(size, size, focal, middle, bend, three(turn))
        return found

    @cached_property
    def grids(self) -> dict[tuple[float, int], np.ndarray]:
        """Unit rays (H, W, 3) by where a lens faces, and by rays across a pixel."""
        found = {}
        for facing, lens in self.lenses.items():
            for finer in (1, 2):
                at = (np.arange(finer * lens.width) + 0.5) / finer
                pixels = np.stack(np.meshgrid(at, at), axis=-1)
                found[facing, finer] = unproject(lens, pixels)
        return found

    def rays_of(self, facing: float) -> np.ndarray:
        """Unit rays (H, W, 3), rig frame, of the pixels of a lens's picture."""
        return self.grids[facing, 1]

    def projected(self, picture: np.ndarray, facing: float) -> np.ndarray:
        """Fisheye (size, size, 3)."""
        lens = self.lenses[facing]
        seen = sampled(picture, self.grids[facing, 2], cv2.INTER_CUBIC)
        fisheye = cv2.resize(seen, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        return np.maximum(fisheye, 0)

    def record(self, time: float, facing: float, f: int, samples: int) -> View:
        """Radiance that one lens gathers, none beyond its circle."""
        view = super().record(time, facing, f, samples)
        limit = np.cos(np.radians(TwoLenses().half_fov_deg))
        inside = facing * self.rays_of(facing)[..., 2:] > limit
        return view._replace(radiance=view.radiance * inside)

    def joined(self, front: np.ndarray, back: np.ndarray, time: float) -> np.ndarray:
        """Both fisheyes beside each other."""
        return np.concatenate([front, back], axis=1)


class _Look:
    """Optics, sensor and processing of both lenses, from radiance to grey values."""

    def __init__(self, camera: Camera, rng: np.random.Generator) -> None:
        self.effects, self.rng, self.metered = camera.effects, rng, camera.metered
        self.ahead = {facing: camera.rays_of(facing)[..., 2] for facing in (1.0, -1.0)}
        drift = rng.standard_normal((len(self.metered), 4))
        slow = gaussian_filter1d(drift, 3, axis=0, mode="wrap")
        self.drift = slow / slow.std(axis=0)  # (F, 4): exposure, red, green, blue
        self.before: dict[float, np.ndarray] = {}

    def start_burst(self) -> None:
        """Forget the denoiser's history."""
        self.before.clear()

    def processed(self, view: View, f: int) -> np.ndarray:
        """Picture (H, W, 3) float32, 0..255, of what a lens gathered for frame f."""
        on, light, facing = self.effects, view.radiance.copy(), view.facing
        if "flare" in on:
            light += _glare(light)
        if "colour" in on:
            angle = np.arccos(np.clip(facing * self.ahead[facing], -1, 1)).astype(np.float32)
            tint = np.array([1.03, 1.0, 0.97] if facing > 0 else [0.96, 0.98, 1.02], np.float32)
            light *= tint * (1 - 0.25 * (angle[..., None] / (np.pi / 2)) ** 2)
        if "wander" in on:
            gain = self.metered[f] ** -0.6 * (1 + 0.04 * self.drift[f, 0])
            light *= np.float32(gain) * (1 + 0.03 * self.drift[f, 1:]).astype(np.float32)
        if "mosaic" in on:
            light = _mosaic(light)
        if "noise" in on:
            sigma = np.sqrt(np.maximum(light, 0) / ELECTRONS + (READ_NOISE / ELECTRONS) ** 2)
            light += sigma * self.rng.standard_normal(light.shape, dtype=np.float32)
        if "mosaic" in on:
            light = _demosaiced(light)
        grey = 1 - np.exp(-EXPOSURE * np.maximum(light, 0))
        if "denoise" in on:
            grey = self._denoised(grey, facing)
        if "tone" in on:
            grey = 0.5 * grey + 0.5 * grey**2 * (3 - 2 * grey)
            grey = grey + 0.4 * (grey - cv2.GaussianBlur(grey, (0, 0), 12))
        if "sharpen" in on:
            grey = grey + 0.8 * (grey - cv2.GaussianBlur(grey, (0, 0), 1.0))
        return 255 * np.clip(grey, 0, 1)

    def _denoised(self, grey: np.ndarray, facing: float) -> np.ndarray:
        """Mean with the last output where both agree within the noise, after a small blur."""
        last = self.before.get(facing)
        if last is not None:
            apart = cv2.GaussianBlur(grey - last, (0, 0), 1.5)
            similar = np.exp(-0.5 * (np.abs(apart).max(axis=2, keepdims=True) / 0.02) ** 2)
            grey = grey + 0.7 * similar * (last - grey)
        self.before[facing] = grey
        return grey


def _linear(picture: np.ndarray) -> np.ndarray:
    """Radiance of a rendered picture, 0..255, whose tone curve is undone."""
    return np.minimum(-np.log1p(-np.minimum(picture, 254.99) / 255) / EXPOSURE, _MAX_RADIANCE)


def _ellipsoid(
    origin: np.ndarray, rays: np.ndarray, centre: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) along rays (N, 3) to an ellipsoid, 0 = missed, and points on it, scaled."""
    a, b = rays / radii, (origin - centre) / radii
    aa, ab, bb = (a * a).sum(axis=1), a @ b, b @ b - 1
    root = ab**2 - aa * bb
    distance = np.where(root > 0, (-ab - np.sqrt(np.maximum(root, 0))) / aa, 0)
    return np.where(distance > 0.1, distance, 0), b + distance[:, None] * a


def _glare(light: np.ndarray) -> np.ndarray:
    """Veil around bright sources, and their ghosts on the other side of the lens's axis."""
    height, width = light.shape[:2]
    small = cv2.resize(
        np.where(light > 2, light, 0), (width // 8, height // 8), interpolation=cv2.INTER_AREA
    )
    veil = cv2.GaussianBlur(small, (0, 0), width / 200)
    ghost = small[::-1, ::-1]  # a half turn about either lens's axis
    ghost = cv2.GaussianBlur(ghost, (0, 0), 1.5) * np.array([0.02, 0.035, 0.03], np.float32)
    return cv2.resize(0.08 * veil + ghost, (width, height), interpolation=cv2.INTER_CUBIC)


def _mosaic(light: np.ndarray) -> np.ndarray:
    """Bayer samples (H, W, 1), RGGB."""
    raw = light[..., 1].copy()
    raw[::2, ::2] = light[::2, ::2, 0]
    raw[1::2, 1::2] = light[1::2, 1::2, 2]
    return raw[..., None]


def _demosaiced(raw: np.ndarray) -> np.ndarray:
    scale = 65535 / _MAX_RADIANCE
    counts = np.clip(raw[..., 0] * scale, 0, 65535).astype(np.uint16)
    return cv2.cvtColor(counts, cv2.COLOR_BayerRGGB2RGB_EA).astype(np.float32) / np.float32(scale)


def encoded(bursts: list[list[np.ndarray]], deep: bool, folder: Path) -> list[np.ndarray]:
    """Last frames of bursts (H, W, 3) RGB 0..255 as x265 leaves them, uint8.

    The quantiser is the one that a film of I P P P ... at `BITS_PER_PIXEL` would have: bits of an
    intra-coded frame and of GOP - 1 predicted ones are those of the bursts.
    """
    height, width = bursts[0][0].shape[:2]
    budget = GOP * BITS_PER_PIXEL * width * height
    sample = bursts[:: max(len(bursts) // 8, 1)]
    low, high = 12, 45
    while low < high:  # the smallest quantiser that the budget affords
        qp = (low + high) // 2
        intra, predicted = _encode(sample, qp, deep, folder / "sample.mp4")
        low, high = (low, qp) if intra + (GOP - 1) * predicted <= budget else (qp + 1, high)
    _encode(bursts, low, deep, folder / "film.mp4")
    print(f"x265, quantiser {low}", flush=True)
    return _decode(folder / "film.mp4", len(bursts[0]))


def _encode(bursts: list[list[np.ndarray]], qp: int, deep: bool, path: Path) -> tuple[float, float]:
    """Write a video in which each burst starts with an intra-coded frame; mean bits of those and of
    predicted ones."""
    import av
    from av.video.frame import PictureType

    bits: dict[bool, list[int]] = {True: [], False: []}
    options = {
        "preset": "fast",
        "x265-params": f"qp={qp}:bframes=0:pools=none:frame-threads=1:log-level=none:scenecut=0",
    }
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=Fraction(30), options=options)
        stream.height, stream.width = bursts[0][0].shape[:2]
        stream.pix_fmt = "yuv420p10le" if deep else "yuv420p"
        packets = []
        for burst in bursts:
            for k, picture in enumerate(burst):
                if deep:
                    counts = (257 * np.clip(picture, 0, 255)).astype(np.uint16)
                    frame = av.VideoFrame.from_ndarray(counts, format="rgb48le")
                else:
                    counts = np.clip(picture + 0.5, 0, 255).astype(np.uint8)
                    frame = av.VideoFrame.from_ndarray(counts, format="rgb24")
                frame.pict_type = PictureType.I if k == 0 else PictureType.P
                packets += stream.encode(frame)
        for packet in [*packets, *stream.encode()]:
            bits[packet.is_keyframe].append(8 * packet.size)
            container.mux(packet)
    return float(np.mean(bits[True])), float(np.mean(bits[False]))


def _decode(path: Path, length: int) -> list[np.ndarray]:
    import av

    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    return frames[length - 1 :: length]


def write_film(camera: Camera, out: Path) -> None:
    """Write `images/` with timestamps.csv, `groundtruth.tum` and `depth/` of a camera's film; of a
    raw one also `calibration.json`."""
    (out / "images").mkdir(parents=True)
    truth = camera.truth()
    compressed = bool(camera.effects & {"hevc", "hevc10"})
    if compressed:
        kept = encoded(list(camera.frames()), "hevc10" in camera.effects, out)
    else:
        kept = (burst[-1] for burst in camera.frames())
    sides: tuple[str, ...] = ("",)
    if isinstance(camera, RawCamera):
        sides, rig = ("front", "back"), (camera.lenses[1.0], camera.lenses[-1.0])
        centre = np.array([0, 0, TwoLenses().baseline / 2])
        (out / "calibration.json").write_text(json.dumps(calibration_json(rig, centre, "m", {})))
    for side in sides:
        (out / "images" / side).mkdir(exist_ok=True)
    rows = ["name,timestamp"]
    for f, picture in enumerate(kept):
        rgb = np.clip(picture + 0.5 * (picture.dtype != np.uint8), 0, 255)
        quality = 100 if compressed else JPEG_QUALITY
        name = f"{f:06d}.jpg"
        for side, part in zip(sides, np.split(rgb.astype(np.uint8), len(sides), 1), strict=True):
            write_image(out / "images" / side / name, part, quality)
        rows.append(f"{name},{truth.timestamps[f]:.6f}")
    (out / "images" / "timestamps.csv").write_text("\n".join([*rows, ""]))
    write_tum(out / "groundtruth.tum", truth)
    write_depth(out / "depth", camera.scene, truth, camera.width // 4)


def furnished(scene: Scene, effects: frozenset[str], share: float, time: float) -> Scene:
    """The scene with the things among `effects` as they stand at a time.

    Args:
        share: of the walk's time that has passed.
        time: seconds.
    """
    mesh, rng = MeshBuilder(), np.random.default_rng(5)
    if "door" in effects:
        opened = np.clip((share - DOOR_OPENS[0]) / (DOOR_OPENS[1] - DOOR_OPENS[0]), 0, 1)
        angle = np.radians(DOOR_DEG) * opened**2 * (3 - 2 * opened)
        leaf = DOOR_SIZE[0] * np.array([np.cos(angle), 0, -np.sin(angle)])
        image = mesh.texture(pictures.picture(rng, 480, 220, 1))
        mesh.face(DOOR_HINGE, leaf, DOOR_SIZE[1] * _DOWN, image)
    if "curtain" in effects:
        _hang_curtain(mesh, rng, time)
    if "mirror" in effects:  # the last face
        black = mesh.texture(np.zeros((8, 8, 3), np.uint8))
        mesh.panel(MIRROR_CENTRE, (0, 0, -1), MIRROR_SIZE, black)
    return _joined(scene, mesh.build()) if effects & {"door", "curtain", "mirror"} else scene


def _hang_curtain(mesh: MeshBuilder, rng: np.random.Generator, time: float) -> None:
    """Add a cloth of triangles that waves, most at its lower edge."""
    columns, rows = CURTAIN_FACES
    a, b = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    folds = np.sin(22 * a - 2.6 * time) + 0.7 * np.sin(9 * a + 2 * b + 1.7 * time)
    depth = CURTAIN_SWING / 1.7 * (0.3 + 0.7 * b) * folds
    knots = np.stack([CURTAIN_SIZE[0] * a, CURTAIN_SIZE[1] * b, depth], axis=-1) + CURTAIN_CORNER
    cloth = pictures.picture(rng, 480, 384, 2)
    height, width = cloth.shape[0] // rows, cloth.shape[1] // columns
    for j in range(rows):
        for i in range(columns):
            piece = cloth[j * height : (j + 1) * height, i * width : (i + 1) * width]
            here, right, below, last = (knots[j + y, i + x] for y in (0, 1) for x in (0, 1))
            image = mesh.texture(piece)
            mesh.face(here, right - here, below - here, image, triangle=True)
            image = mesh.texture(piece[::-1, ::-1].copy())
            mesh.face(last, below - last, right - last, image, triangle=True)


def _joined(scene: Scene, other: Scene) -> Scene:
    """Both scenes in one, whose hierarchy has two roots."""
    faces, nodes = len(scene.corners), len(scene.node_skip)
    moved = other._replace(
        textures=other.textures + len(scene.levels),
        node_skip=other.node_skip + nodes,
        node_face=np.where(other.node_face < 0, -1, other.node_face + faces),
        levels=other.levels + np.array([len(scene.texels), 0, 0]),
        light_grids=other.light_grids + np.array([len(scene.light), 0, 0]),
    )
    return Scene(*(np.concatenate(pair) for pair in zip(scene, moved, strict=True)))


def seen(scene: Scene, eye: Eye, width: int, mirror: bool) -> np.ndarray:
    """Picture (width / 2, width, 3) of an eye as by `render_eye`; `mirror`: the last texture of the
    scene is a mirror, in which the eye sees what the mirrored eye sees from behind it."""
    size = width, width // 2
    shown = render_eye(scene, eye, *size)
    if mirror:
        glass = scene.textures == len(scene.levels) - 1
        glowing = scene._replace(emissions=np.where(glass, 1e3, scene.emissions))
        share = (render_eye(glowing, eye, *size) - shown) / 255
        low = scene.corners[:, 2] + np.minimum(scene.edges[..., 2], 0).sum(axis=1)
        room = scene._replace(spans=np.where(low > MIRROR_CENTRE[2] - 1e-6, -1, scene.spans))
        eyes = eye.world_T_eyes * np.array([1, 1, -1])[:, None]
        eyes[:, 2, 3] += 2 * MIRROR_CENTRE[2]
        shown += share * render_eye(room, eye._replace(world_T_eyes=eyes), *size)
    return shown
