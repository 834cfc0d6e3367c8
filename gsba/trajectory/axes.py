"""Rotation of a trajectory's camera axes against those of raw pictures."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse
from gsba.types import CoarsePoses, PoseSource

_MIN_ROTATION_RAD = np.deg2rad(1.0)  # rotation of a step below which its axis is uncertain
_MAX_RESIDUAL_RATIO = 0.6  # largest residual of an accepted rotation, relative to that of no
# rotation
QUARTER_TURNS = [Rotation.from_euler("z", 90 * n, degrees=True).as_matrix() for n in range(4)]


def quarter_turn(coarse: CoarsePoses, world_T_rigs: np.ndarray) -> np.ndarray:
    """ours_R_theirs (3, 3), by quarter turns about the forward axis, under which steps agree best.

    A trajectory comes from upright panoramas, but sensors may be mounted turned by quarters.

    Args:
        world_T_rigs: (F, 4, 4) estimated poses, up to a similarity.
    """
    own = coarse.sources == PoseSource.SLAM
    own = own[:-1] & own[1:]
    ours, theirs = _steps(world_T_rigs)[own], _steps(coarse.world_T_rigs)[own]
    left = [_residual(ours, theirs, turn) for turn in QUARTER_TURNS]
    best = int(np.argmin(left))
    return QUARTER_TURNS[best if left[best] < _MAX_RESIDUAL_RATIO * left[0] else 0]


def _steps(poses: np.ndarray) -> np.ndarray:
    return inverse(poses[:-1]) @ poses[1:]


def _residual(ours: np.ndarray, theirs: np.ndarray, turn: np.ndarray) -> float:
    """Sum of differences in rotation and direction of steps (N, 4, 4), theirs in rotated axes."""
    turns = [Rotation.from_matrix(steps[:, :3, :3]).as_rotvec() for steps in (ours, theirs)]
    moves = [steps[:, :3, 3] for steps in (ours, theirs)]
    ways = [move / np.maximum(np.linalg.norm(move, axis=1), 1e-12)[:, None] for move in moves]
    sizes = [np.linalg.norm(vectors, axis=1) for vectors in turns]
    turned = np.linalg.norm(turns[0] - turns[1] @ turn.T, axis=1) / (sum(sizes) + _MIN_ROTATION_RAD)
    moved = np.linalg.norm(ways[0] - ways[1] @ turn.T, axis=1) / 2
    return float(np.sum(turned + moved))
