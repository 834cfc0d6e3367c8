"""A camera of several lenses as `_camera_kernels` reads it: observations, variables, columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from factors.cholesky import DIM

MOTION, TURNS = 6, 2  # coordinates of what frames have of their own
FRONT, OTHER = 7, 10  # coordinates of what raw lenses are: all but the front one are turned, too


class LensSightings(NamedTuple):
    """Observations of landmarks by the lenses of frames, sorted by landmark, then frame."""

    offsets: np.ndarray  # (J + 1,) int64: landmark j owns rows offsets[j]:offsets[j + 1]
    frames: np.ndarray  # (O,) int64
    points: np.ndarray  # (O,) int64
    measured: np.ndarray  # (O, 3) float64: unit direction in the panorama, rig frame | of raw
    # pairs the pixel in the fisheye, corner origin, and 0
    whiteners: np.ndarray  # (O, 2, 2) float64: 1/rad on the direction's tangent_basis | 1/pixel
    lenses: np.ndarray  # (O,) int64: lens that sees it, 0 = the front one
    fractions: np.ndarray  # (O,) float64: when its row is read, part of the readout from the middle


class CameraRows(NamedTuple):
    """The cameras' values, and what derivatives by their variables need; L counts the lenses of all
    cameras, one camera after the other."""

    motions: np.ndarray  # (F, 6): of each frame during its readout, [rotation rad, translation]
    velocities: np.ndarray  # (F, 6): their derivative by the readout's duration
    axes: np.ndarray  # (F, 3, 3): rig_R_lenses
    by_turn: np.ndarray  # (L, F, 3, 3): derivative of axes @ centre by the frame's turn
    centres: np.ndarray  # (L, 3) of the lenses, lenses' frame, map units; mean 0 in each camera
    inverse_radii: np.ndarray  # (L,) of each lens's stitching, 1 / map units
    radius_by_centre: np.ndarray  # (S,) its derivative by the shared columns of centres, where it
    # goes with these
    lenses: np.ndarray  # (L, 16) raw: focal length, principal point, k1 to k4, rig_R_lens
    steps: np.ndarray  # (L, 7) derivative of (log f, principal point, k1 to k4) by the variables
    by_lens_turn: np.ndarray  # (L, 3, 3) derivative of a lens's left turn by its variable


class Columns(NamedTuple):
    """Where the coordinates of variables start in Jacobians of what a lens sees (L,) int64; -1 = it
    is none."""

    motion: np.ndarray  # of frames; poses have columns 0 to 5
    turns: np.ndarray
    centres: np.ndarray  # of what frames share: those of its camera's lenses but the last one
    radius: np.ndarray
    lenses: np.ndarray  # of this lens's own
    readout: np.ndarray
    first: np.ndarray  # first lens of its camera
    last: np.ndarray  # last lens of its camera


@dataclass(frozen=True)
class LensVariables:
    """Which keys the variables of one camera have that all its frames share, all of them vectors,
    and what the camera is beside them. Without any it is one centre."""

    centres: Sequence[int] = ()  # (L - 1) keys (3,): centres of all lenses but the last one, whose
    # is minus their sum; lenses' frame, map units
    readout: int | None = None  # key (1,): duration, s
    radius: int | None = None  # key (1,): inverse of the stitching radius, 1 / map units
    front_by_radius: float = 0.0  # where it is no variable: half the distance between the first two
    # lenses, part of the stitching radius; 0 = infinity
    lenses: Sequence[int] | None = None  # 3 L - 1 keys of raw lenses: changes of the front lens's
    # focal length and principal point (3,), relative to the focal length, and of its k1 to k4 (4,);
    # of each other lens its changes (3,), (4,), and its rotation (3,) rad
    calibration: np.ndarray | None = None  # (L, 16) rows as in CameraRows, at no change
    turning: bool = False  # True if frames' turns act on its lenses

    def __post_init__(self) -> None:
        if (self.lenses is None) != (self.calibration is None):
            raise ValueError("lenses and their calibration are given together")

    @property
    def num_lenses(self) -> int:
        """L."""
        return len(self.centres) + 1

    @cached_property
    def shared(self) -> tuple[tuple[int, int], ...]:
        """Keys, and how many coordinates each has."""
        found = [(key, 3) for key in self.centres]
        if self.radius is not None:
            found.append((self.radius, 1))
        if self.lenses is not None:
            found += zip(self.lenses, lens_sizes(self.num_lenses), strict=True)
        if self.readout is not None:
            found.append((self.readout, 1))
        return tuple(found)

    def columns(self, motion: int, turns: int, start: int, first: int) -> Columns:
        """Columns (L,) of what its lenses see, the first of which is the `first`-th of all: motion
        and turns are columns of what frames have of their own, start is the first of what all its
        frames share."""
        num = self.num_lenses
        last = start + 3 * (num - 1)
        radius, last = (-1, last) if self.radius is None else (last, last + 1)
        lenses = np.full(num, -1)
        if self.lenses is not None:
            lenses = last + np.array([0, *(FRONT + OTHER * n for n in range(num - 1))])
            last += FRONT + OTHER * (num - 1)
        moving = self.readout is not None
        alike = {
            "motion": motion if moving else -1,
            "turns": turns if self.turning else -1,
            "centres": start,
            "radius": radius,
            "readout": last if moving else -1,
            "first": first,
            "last": first + num - 1,
        }
        return Columns(lenses=lenses, **{name: np.full(num, at) for name, at in alike.items()})

    def given_centres(self, values: gtsam.Values) -> np.ndarray:
        """Centres (L, 3) of all lenses."""
        given = [vector(values, key) for key in self.centres]
        return np.array([*given, -np.sum(given, axis=0)]) if given else np.zeros((1, 3))

    def stitching(self, values: gtsam.Values) -> tuple[float, np.ndarray]:
        """Inverse of the stitching radius, and its derivative (3 (L - 1),) by the centres."""
        num = self.num_lenses
        if self.radius is not None:
            return float(vector(values, self.radius)[0]), np.zeros(3 * (num - 1))
        if not self.front_by_radius:
            return 0.0, np.zeros(3 * (num - 1))
        by_given = half_baseline(num)
        half = by_given @ np.concatenate([vector(values, key) for key in self.centres])
        inverse = self.front_by_radius / float(np.linalg.norm(half))
        return inverse, -inverse * (half @ by_given) / float(half @ half)

    def raw(self, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lenses (L, 16), and derivatives (L, 7) and (L, 3, 3) as in `CameraRows`."""
        num = self.num_lenses
        if self.lenses is None or self.calibration is None:
            return np.zeros((num, 16)), np.ones((num, 7)), np.tile(np.eye(3), (num, 1, 1))
        parts = [vector(values, key) for key in self.lenses]
        changes = [parts[:2], *(parts[k : k + 3] for k in range(2, len(parts), 3))]
        lenses, steps, by_turn = [], np.ones((num, 7)), np.zeros((num, 3, 3))
        for lens, (own, radial, *turn) in enumerate(changes):
            moved = self.calibration[lens].copy()
            steps[lens, 1:3] = moved[0]
            moved[1:3] += moved[0] * own[1:3]
            moved[0] *= np.exp(own[0])
            moved[3:7] += radial
            if turn:
                rotation = Rotation.from_rotvec(turn[0]).as_matrix()
                moved[7:] = (rotation @ moved[7:].reshape(3, 3)).ravel()
                by_turn[lens] = _right(-turn[0][None])[0]
            lenses.append(moved)
        return np.array(lenses), steps, by_turn


@dataclass(frozen=True)
class CameraVariables:
    """Which keys the variables of all cameras and of their frames have. Poses are Pose3, all others
    vectors."""

    poses: Sequence[int]  # (F,) keys of world_T_rig
    cameras: Sequence[LensVariables]  # (C,)
    of_frame: np.ndarray | None = None  # (F,) int, camera of each frame; None = there is one
    axes: np.ndarray | None = None  # (F, 3, 3) rig_R_lenses at turns of 0; None = the rig's
    turns: Sequence[int] | None = None  # (F,) keys (2,) rad: turns about x and y of these axes
    motions: Sequence[int] | None = None  # (F,) keys (6,): what frames move beside their velocity
    velocities: np.ndarray | None = None  # (F, 6) per s

    def __post_init__(self) -> None:
        read = any(camera.readout is not None for camera in self.cameras)
        if not (self.motions is None) == (self.velocities is None) == (not read):
            raise ValueError("readout, motions and velocities are given together")
        if self.turns is not None and self.axes is None:
            raise ValueError("turns need axes that they turn")

    @cached_property
    def of_frames(self) -> tuple[Sequence[int], ...]:
        """Keys (F,) of each kind that frames have."""
        return tuple(keys for keys in (self.poses, self.motions, self.turns) if keys is not None)

    @cached_property
    def shared(self) -> tuple[tuple[int, int], ...]:
        """Keys of what all frames of a camera share, and how many coordinates each has."""
        return tuple(one for camera in self.cameras for one in camera.shared)

    @cached_property
    def first_lenses(self) -> np.ndarray:
        """Number (C,) int64 of the first lens of each camera."""
        return np.cumsum([0, *(camera.num_lenses for camera in self.cameras[:-1])])

    @cached_property
    def columns(self) -> Columns:
        """Where they start."""
        motion = -1 if self.motions is None else DIM
        turns = -1 if self.turns is None else DIM + (0 if self.motions is None else MOTION)
        parts, start = list[Columns](), 0
        for camera, first in zip(self.cameras, self.first_lenses.tolist(), strict=True):
            parts.append(camera.columns(motion, turns, start, first))
            start += sum(dim for _, dim in camera.shared)
        return Columns(
            *(np.concatenate(part).astype(np.int64) for part in zip(*parts, strict=True))
        )

    @cached_property
    def own_places(self) -> np.ndarray:
        """(K,) of the columns that frames have, among six coordinates of each kind."""
        sizes = [DIM, *([] if self.motions is None else [MOTION])]
        sizes += [] if self.turns is None else [TURNS]
        return _places(sizes)

    @cached_property
    def shared_places(self) -> np.ndarray:
        """(S,) of the shared columns, among six coordinates of each variable."""
        return _places([dim for _, dim in self.shared])

    def rows(self, values: gtsam.Values) -> CameraRows:
        """The cameras at some values."""
        num = len(self.poses)
        motions, velocities = np.zeros((num, 6)), np.zeros((num, 6))
        if self.motions is not None and self.velocities is not None:
            velocities = np.ascontiguousarray(self.velocities, dtype=np.float64)
            motions = np.array([vector(values, key) for key in self.motions])
            durations = [
                0.0 if camera.readout is None else float(vector(values, camera.readout)[0])
                for camera in self.cameras
            ]
            of_frame = 0 if self.of_frame is None else self.of_frame[:, None]
            motions += np.array(durations)[of_frame] * velocities
        centres = np.concatenate([camera.given_centres(values) for camera in self.cameras])
        axes = np.tile(np.eye(3), (num, 1, 1))
        by_turn = np.zeros((len(centres), num, 3, 3))
        if self.axes is not None:
            axes = np.ascontiguousarray(self.axes, dtype=np.float64)
        if self.turns is not None:
            turns = np.zeros((num, 3))
            turns[:, :2] = [vector(values, key) for key in self.turns]
            axes = axes @ Rotation.from_rotvec(turns).as_matrix()
            by_turn = -(axes @ _cross(centres)[:, None] @ _right(turns))
        inverse, by_centre = list[np.ndarray](), np.zeros(len(self.shared_places))
        for camera, first in zip(self.cameras, self.first_lenses, strict=True):
            found, slope = camera.stitching(values)
            inverse.append(np.full(camera.num_lenses, found))
            start = self.columns.centres[first]
            by_centre[start : start + len(slope)] = slope
        raw = [camera.raw(values) for camera in self.cameras]
        found = motions, velocities, axes, by_turn, centres, np.concatenate(inverse), by_centre
        return CameraRows(*found, *(np.concatenate(part) for part in zip(*raw, strict=True)))


def lens_sizes(num: int) -> tuple[int, ...]:
    """Coordinates of each variable of L raw lenses: focal length and principal point, radial
    terms, and of all but the front one a rotation."""
    return 3, 4, *((3, 4, 3) * (num - 1))


def half_baseline(num: int) -> np.ndarray:
    """Matrix (3, 3 (L - 1)) that takes the centres of all lenses but the last one to half the
    vector from the second lens to the front one."""
    if num == 2:
        return np.eye(3)
    rest = np.zeros((3, 3 * (num - 3)))
    return np.concatenate([0.5 * np.eye(3), -0.5 * np.eye(3), rest], axis=1)


def vector(values: gtsam.Values, key: int) -> np.ndarray:
    """A vector of a graph's values, of any dimension."""
    return np.asarray(values.atVector(key), dtype=np.float64)


def _places(sizes: Sequence[int]) -> np.ndarray:
    parts = [DIM * n + np.arange(size) for n, size in enumerate(sizes)]
    return np.concatenate(parts)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Matrices (..., 3, 3) whose product with another vector is the cross product."""
    out = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _right(vectors: np.ndarray) -> np.ndarray:
    """Right Jacobians (N, 3, 3) of rotations at rotation vectors (N, 3)."""
    crossed = _cross(vectors)
    angles = np.linalg.norm(vectors, axis=-1)[:, None, None]
    small = angles < 1e-3
    t = np.where(small, 1.0, angles)
    a = np.where(small, 0.5 - angles**2 / 24, (1 - np.cos(t)) / t**2)
    b = np.where(small, 1 / 6 - angles**2 / 120, (t - np.sin(t)) / t**3)
    return np.eye(3) - a * crossed + b * crossed @ crossed
