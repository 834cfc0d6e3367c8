"""A camera with two lenses as `_camera_kernels` reads it: observations, variables, columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

DIM = 6
MOTION, TURNS = 6, 2  # coordinates of what frames have of their own
FRONT, BACK = 7, 10  # coordinates of what raw lenses are: the back one is turned, too
OF_LENSES = (3, 4, 3, 4, 3)  # of each variable of raw lenses: focal length and principal point,
# radial terms, those of the back lens, its turn


class Sightings(NamedTuple):
    """Observations of landmarks by the lenses of frames, sorted by landmark, then frame."""

    offsets: np.ndarray  # (J + 1,) int64: landmark j owns rows offsets[j]:offsets[j + 1]
    frames: np.ndarray  # (O,) int64
    points: np.ndarray  # (O,) int64
    measured: np.ndarray  # (O, 3) float64: unit direction in the panorama, rig frame | of raw
    # pairs the pixel in the fisheye, corner origin, and 0
    whiteners: np.ndarray  # (O, 2, 2) float64: 1/rad on the direction's tangent_basis | 1/pixel
    signs: np.ndarray  # (O,) float64: 1 = the front lens sees it, -1 = the back one
    fractions: np.ndarray  # (O,) float64: when its row is read, part of the readout from the middle


class CameraRows(NamedTuple):
    """A camera's values, and what derivatives by its variables need."""

    motions: np.ndarray  # (F, 6): of each frame during its readout, [rotation rad, translation]
    velocities: np.ndarray  # (F, 6): their derivative by the readout's duration
    axes: np.ndarray  # (F, 3, 3): rig_R_lenses
    by_turn: np.ndarray  # (F, 3, 3): derivative of axes @ centre by the frame's turn
    centre: np.ndarray  # (3,) of the front lens, lenses' frame, map units
    inverse_radius: float  # of the stitching, 1 / map units
    radius_by_centre: np.ndarray  # (3,) its derivative by the centre, where it goes with that
    lenses: np.ndarray  # (2, 16) of raw pairs: focal length, principal point, k1 to k4, rig_R_lens
    steps: np.ndarray  # (2, 7) derivative of (log f, principal point, k1 to k4) by the variables
    by_back_turn: np.ndarray  # (3, 3) derivative of the back lens's left turn by its variable


class Columns(NamedTuple):
    """Where the coordinates of each variable start in Jacobians; -1 = it is none."""

    motion: int  # of frames; poses have columns 0 to 5
    turns: int
    radius: int  # of what all frames share; the centre has columns 0 to 2
    lenses: int
    readout: int


@dataclass(frozen=True)
class CameraVariables:
    """Which keys a camera's variables have, and what it is beside them. Poses are Pose3, all
    others vectors."""

    poses: Sequence[int]  # (F,) keys of world_T_rig
    centre: int  # key (3,): the front lens's centre, lenses' frame, map units
    axes: np.ndarray | None = None  # (F, 3, 3) rig_R_lenses at turns of 0; None = the rig's
    turns: Sequence[int] | None = None  # (F,) keys (2,) rad: turns about x and y of these axes
    readout: int | None = None  # key (1,): duration, s
    motions: Sequence[int] | None = None  # (F,) keys (6,): what frames move beside their velocity
    velocities: np.ndarray | None = None  # (F, 6) per s
    radius: int | None = None  # key (1,): inverse of the stitching radius, 1 / map units
    front_by_radius: float = 0.0  # where it is no variable: the distance of the lens's centre, part
    # of the stitching radius; 0 = infinity
    lenses: Sequence[int] | None = None  # 5 keys of raw pairs: changes of the front lens's focal
    # length and principal point (3,), relative to the focal length, and of its k1 to k4 (4,); the
    # back lens's changes (3,), (4,), and its rotation (3,) rad
    calibration: np.ndarray | None = None  # (2, 16) rows as in CameraRows, at no change

    def __post_init__(self) -> None:
        together = [self.readout, self.motions, self.velocities]
        if any(given is None for given in together) != all(given is None for given in together):
            raise ValueError("readout, motions and velocities are given together")
        if self.turns is not None and self.axes is None:
            raise ValueError("turns need axes that they turn")
        if (self.lenses is None) != (self.calibration is None):
            raise ValueError("lenses and their calibration are given together")

    @cached_property
    def of_frames(self) -> tuple[Sequence[int], ...]:
        """Keys (F,) of each kind that frames have."""
        return tuple(keys for keys in (self.poses, self.motions, self.turns) if keys is not None)

    @cached_property
    def shared(self) -> tuple[tuple[int, int], ...]:
        """Keys of what all frames share, and how many coordinates each has."""
        found = [(self.centre, 3)]
        if self.radius is not None:
            found.append((self.radius, 1))
        if self.lenses is not None:
            found += zip(self.lenses, OF_LENSES, strict=True)
        if self.readout is not None:
            found.append((self.readout, 1))
        return tuple(found)

    @cached_property
    def columns(self) -> Columns:
        """Where they start."""
        motion = -1 if self.motions is None else DIM
        turns = -1 if self.turns is None else DIM + (0 if self.motions is None else MOTION)
        radius, last = (-1, 3) if self.radius is None else (3, 4)
        lenses = -1 if self.lenses is None else last
        last += 0 if self.lenses is None else FRONT + BACK
        return Columns(motion, turns, radius, lenses, -1 if self.readout is None else last)

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
        """The camera at some values."""
        num, centre = len(self.poses), vector(values, self.centre)
        motions, velocities = np.zeros((num, 6)), np.zeros((num, 6))
        if self.motions is not None and self.readout is not None and self.velocities is not None:
            velocities = np.ascontiguousarray(self.velocities, dtype=np.float64)
            motions = np.array([vector(values, key) for key in self.motions])
            motions += vector(values, self.readout)[0] * velocities
        axes, by_turn = np.tile(np.eye(3), (num, 1, 1)), np.zeros((num, 3, 3))
        if self.axes is not None:
            axes = np.ascontiguousarray(self.axes, dtype=np.float64)
        if self.turns is not None:
            turns = np.zeros((num, 3))
            turns[:, :2] = [vector(values, key) for key in self.turns]
            axes = axes @ Rotation.from_rotvec(turns).as_matrix()
            by_turn = np.ascontiguousarray(-(axes @ _cross(centre) @ _right(turns)))
        length = float(np.linalg.norm(centre))
        inverse, by_centre = 0.0, np.zeros(3)
        if self.radius is not None:
            inverse = float(vector(values, self.radius)[0])
        elif self.front_by_radius:
            inverse = self.front_by_radius / length
            by_centre = -inverse * centre / length**2
        given = motions, velocities, axes, by_turn, centre, inverse, by_centre
        return CameraRows(*given, *self._lenses(values))

    def _lenses(self, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self.lenses is None or self.calibration is None:
            return np.zeros((2, 16)), np.ones((2, 7)), np.eye(3)
        parts = [vector(values, key) for key in self.lenses]
        changes, lenses = np.array([np.hstack(parts[:2]), np.hstack(parts[2:4])]), []
        for lens, change in zip(self.calibration, changes, strict=True):
            moved = lens.copy()
            moved[0] *= np.exp(change[0])
            moved[1:3] += lens[0] * change[1:3]
            moved[3:7] += change[3:]
            lenses.append(moved)
        turn = Rotation.from_rotvec(parts[4]).as_matrix()
        lenses[1][7:] = (turn @ lenses[1][7:].reshape(3, 3)).ravel()
        steps = np.ones((2, 7))
        steps[:, 1:3] = self.calibration[:, :1]
        return np.array(lenses), steps, np.ascontiguousarray(_right(-parts[4][None])[0])


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
