"""Conventions of trajectory files: camera axes, order of quaternions, direction of poses."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.geometry import (
    inverse,
    pose,
    quaternion_from_rotation,
    relative_steps,
    rotation_from_quaternion,
)
from gsba.log import GsbaError
from gsba.trajectory.steps import tracked_steps
from gsba.types import CoarsePoses, Trajectory

WXYZ, CAMERA_FROM_WORLD = "wxyz", "camera-from-world"
OURS = "right-down-forward"
_WAYS = {
    "right": (0, 1),
    "left": (0, -1),
    "down": (1, 1),
    "up": (1, -1),
    "forward": (2, 1),
    "back": (2, -1),
}  # way -> index and sign of our axis
QUARTER_TURNS = [Rotation.from_euler("z", 90 * n, degrees=True).as_matrix() for n in range(4)]


@dataclass(frozen=True, slots=True)
class Convention:
    """The convention of a trajectory file; by default that of gsba."""

    w_first: bool = False  # True for quaternions w, x, y, z
    inverted: bool = False  # True for camera_T_worlds
    ours_R_theirs: np.ndarray | None = None  # (3, 3) float64, of camera axes; None = ours

    @classmethod
    def parse(cls, text: str | None) -> "Convention":
        """The convention that words separated by commas name: "wxyz", "camera-from-world", and ways
        of the camera's x, y and z axes like "forward-left-up". Raises GsbaError: another word, or
        axes that are no right-handed system."""
        words = [word.strip() for word in (text or "").split(",") if word.strip()]
        axes = [word for word in words if word not in (WXYZ, CAMERA_FROM_WORLD)]
        known = dict(axis_systems())
        if len(axes) > 1 or not set(axes) <= {*known}:
            raise GsbaError(
                f"--trajectory-format {text}: give {WXYZ}, {CAMERA_FROM_WORLD}, or three ways of "
                f"the camera's x, y and z in a right-handed system, as {OURS} or forward-left-up; "
                "several with commas between"
            )
        rotation = known[axes[0]] if axes and axes[0] != OURS else None
        return cls(WXYZ in words, CAMERA_FROM_WORLD in words, rotation)

    def poses(self, read: Trajectory) -> Trajectory:
        """A trajectory read as if it were in our convention, as world_T_cameras in the file's
        axes."""
        poses = read.world_T_rigs
        if self.w_first:
            poses = pose(w_first(poses[:, :3, :3]), poses[:, :3, 3])
        return replace(read, world_T_rigs=inverse(poses) if self.inverted else poses)

    def in_our_axes(self, trajectory: Trajectory) -> Trajectory:
        """A trajectory of `poses` as world_T_rigs; the world stays."""
        if self.ours_R_theirs is None:
            return trajectory
        turn = pose(self.ours_R_theirs.T, np.zeros(3))
        return replace(trajectory, world_T_rigs=trajectory.world_T_rigs @ turn)


def w_first(rotations: np.ndarray) -> np.ndarray:
    """Rotations (F, 3, 3) whose quaternions were written w, x, y, z and read as x, y, z, w."""
    wxyz = quaternion_from_rotation(rotations)
    return rotation_from_quaternion(wxyz[:, [1, 2, 3, 0]])


def axis_systems() -> Iterator[tuple[str, np.ndarray]]:
    """The 24 right-handed systems of camera axes: ways of x, y and z, and ours_R_theirs (3, 3)."""
    for ways in itertools.product(_WAYS, repeat=3):
        rotation = np.zeros((3, 3))
        for column, way in enumerate(ways):
            axis, sign = _WAYS[way]
            rotation[axis, column] = sign
        if np.linalg.det(rotation) > 0.5:
            yield "-".join(ways), rotation


def quarter_turn(coarse: CoarsePoses, world_T_rigs: np.ndarray) -> np.ndarray:
    """ours_R_theirs (3, 3), by quarter turns about the forward axis, under which steps agree best
    with estimated poses (F, 4, 4): sensors may be mounted turned, unlike upright panoramas."""
    own = tracked_steps(coarse)
    ours, theirs = relative_steps(world_T_rigs)[own], relative_steps(coarse.world_T_rigs)[own]
    left = [_residual(ours, theirs, turn) for turn in QUARTER_TURNS]
    best = int(np.argmin(left))
    return QUARTER_TURNS[best if left[best] < 0.6 * left[0] else 0]


def _residual(ours: np.ndarray, theirs: np.ndarray, turn: np.ndarray) -> float:
    """Sum of differences in rotation and direction of steps (N, 4, 4), theirs in rotated axes."""
    turns = [Rotation.from_matrix(steps[:, :3, :3]).as_rotvec() for steps in (ours, theirs)]
    moves = [steps[:, :3, 3] for steps in (ours, theirs)]
    ways = [move / np.maximum(np.linalg.norm(move, axis=1), 1e-12)[:, None] for move in moves]
    sizes = [np.linalg.norm(vectors, axis=1) for vectors in turns]
    # Below one degree the axis of a step's rotation is uncertain.
    turned = np.linalg.norm(turns[0] - turns[1] @ turn.T, axis=1) / (sum(sizes) + np.deg2rad(1.0))
    moved = np.linalg.norm(ways[0] - ways[1] @ turn.T, axis=1) / 2
    return float(np.sum(turned + moved))
