"""A walk once around that two maps hold: what of them is tested."""

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import bearings_of, context_of, features_of, loop_walk, unit, with_noise

from gsba.config import PairSettings, RefineSettings
from gsba.geometry import pose
from gsba.matching.guided_search import MatchContext
from gsba.similarity import Sim3
from gsba.types import Counts, Landmarks, Solution, Tracks

NUM, POINTS, HALF = 40, 1500, 20
TRUTH = loop_walk(NUM)
EVERYTHING = np.ones(NUM)  # share of the points in reach that each frame shows
SETTINGS = RefineSettings(pairs=PairSettings(window=8))
SCALE = 1.7
MOVE = pose(Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 8.0]))


@cache
def scene(strange: bool = False) -> tuple[MatchContext, Solution, np.ndarray]:
    """`scene_of` the true walk; tests only read it."""
    return scene_of(TRUTH, strange=strange)


def scene_of(
    truth: np.ndarray,
    shown: np.ndarray = EVERYTHING,
    strange: bool = False,
    halves: bool = True,
) -> tuple[MatchContext, Solution, np.ndarray]:
    """Once around, mapped in two halves or at once; `strange`: the second half looks like nothing
    else; `shown`: (F,) share of the points in reach that each frame shows.

    Returns the map in one world, and the point that each of its landmarks is.
    """
    rng, hiding = np.random.default_rng(0), np.random.default_rng(1)
    near = TRUTH[rng.integers(0, NUM, POINTS), :3, 3]
    points = near + rng.uniform(0.8, 2.5, (POINTS, 1)) * unit(rng.normal(size=(POINTS, 3)))
    looks = (200 * rng.random((2, POINTS, 64)) ** 4).astype(np.uint8)
    frames, rows = [], []
    for f, world_T_rig in enumerate(truth):
        seen = np.flatnonzero(np.linalg.norm(points - world_T_rig[:3, 3], axis=1) < 2.6)
        seen = seen[hiding.random(len(seen)) < shown[f]]
        late = int(f >= HALF)
        bearings = with_noise(bearings_of(points[seen], world_T_rig), 3e-4, rng)
        frames.append(features_of(bearings, looks[late if strange else 0][seen]))
        own = 2 * seen + (late if halves else 0)
        rows.append(np.column_stack([own, np.full(len(seen), f), np.arange(len(seen))]))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 1], table[:, 0]))].astype(np.int32)
    kept, renumbered = np.unique(table[:, 0], return_inverse=True)
    own = Tracks(renumbered.astype(np.int32), table[:, 1], table[:, 2], len(kept))
    landmarks = Landmarks(points[kept // 2], own, Counts(len(kept), len(kept), "tracks"))
    return context_of(frames, SETTINGS), Solution(truth, landmarks, 1.0, ()), kept % 2 == 1


def torn(solved: Solution, late: np.ndarray, scale: float, move: np.ndarray) -> Solution:
    """The second half in a world and scale of its own."""
    poses, points = solved.world_T_rigs.copy(), solved.landmarks.points_world.copy()
    poses[HALF:] = Sim3.of(scale, move).poses(poses[HALF:])
    points[late] = scale * points[late] @ move[:3, :3].T + move[:3, 3]
    return replace(
        solved, world_T_rigs=poses, landmarks=replace(solved.landmarks, points_world=points)
    )
