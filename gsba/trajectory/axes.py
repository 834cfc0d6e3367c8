"""How the axes of a trajectory's camera are turned against those of raw pictures."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.geometry import inverse
from gsba.types import CoarsePoses, PoseSource

_LEAST = np.deg2rad(1.0)  # turn of a step below which its axis says little
_CLEARLY = 0.6  # part of what no turn leaves over, below which a turn is believed
QUARTER_TURNS = [Rotation.from_euler("z", 90 * n, degrees=True).as_matrix() for n in range(4)]


def quarter_turn(coarse: CoarsePoses, world_T_rigs: np.ndarray) -> np.ndarray:
    """ours_R_theirs (3, 3), about the way ahead by quarters, that makes steps most alike.

    Panoramas are upright however the camera's sensors lie in it, and a trajectory is of panoramas.

    Args:
        coarse: the trajectory.
        world_T_rigs: (F, 4, 4) poses that were found, each up to one similarity in a world of its
            own.
    """
    own = coarse.sources == PoseSource.SLAM
    own = own[:-1] & own[1:]
    ours, theirs = _steps(world_T_rigs)[own], _steps(coarse.world_T_rigs)[own]
    left = [_left_over(ours, theirs, turn) for turn in QUARTER_TURNS]
    best = int(np.argmin(left))
    return QUARTER_TURNS[best if left[best] < _CLEARLY * left[0] else 0]


def _steps(poses: np.ndarray) -> np.ndarray:
    return inverse(poses[:-1]) @ poses[1:]


def _left_over(ours: np.ndarray, theirs: np.ndarray, turn: np.ndarray) -> float:
    """How differently steps (N, 4, 4) turn and move, theirs in turned axes."""
    turns = [Rotation.from_matrix(steps[:, :3, :3]).as_rotvec() for steps in (ours, theirs)]
    moves = [steps[:, :3, 3] for steps in (ours, theirs)]
    ways = [move / np.maximum(np.linalg.norm(move, axis=1), 1e-12)[:, None] for move in moves]
    sizes = [np.linalg.norm(vectors, axis=1) for vectors in turns]
    turned = np.linalg.norm(turns[0] - turns[1] @ turn.T, axis=1) / (sum(sizes) + _LEAST)
    moved = np.linalg.norm(ways[0] - ways[1] @ turn.T, axis=1) / 2
    return float(np.sum(turned + moved))
