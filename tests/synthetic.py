"""A synthetic world: points around a looping walk, their noisy bearings, and a drifting start."""

from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.bundle.families import Family, MapSnapshot
from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import RefineSettings
from gsba.features import detection
from gsba.geometry import inverse, pose
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.store.shards import Threads
from gsba.types import Features, Keypoints, Tracks

RIG = CubeRig(512, np.pi / 2)
ROS = pose(np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.zeros(3))  # ours_T_forward-left-up


@dataclass(frozen=True)
class World:
    """What is true, and what was seen of it."""

    world_T_rigs: np.ndarray  # (F, 4, 4)
    points_world: np.ndarray  # (J, 3)
    keypoints: Keypoints  # bearings with noise
    tracks: Tracks  # which keypoint shows which point; some do not
    false: np.ndarray  # (O,) bool, observations of something else


class GivenFactors(Family):
    """A family of factors that do not depend on the map."""

    name, digest = "given", "1"

    def __init__(self, factors: gtsam.NonlinearFactorGraph) -> None:
        self.factors = factors

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        return self.factors


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def w_first(world_T_rigs: np.ndarray) -> np.ndarray:
    """Poses as read where their file has quaternions w, x, y, z."""
    xyzw = Rotation.from_matrix(world_T_rigs[:, :3, :3]).as_quat()
    return pose(Rotation.from_quat(xyzw[:, [3, 0, 1, 2]]).as_matrix(), world_T_rigs[:, :3, 3])


def bearings_of(points_world: np.ndarray, world_T_rig: np.ndarray) -> np.ndarray:
    """Unit bearings (N, 3) in the rig frame of points (N, 3)."""
    return unit((points_world - world_T_rig[:3, 3]) @ world_T_rig[:3, :3])


def with_noise(bearings: np.ndarray, sigma_rad: float, rng: np.random.Generator) -> np.ndarray:
    """Bearings turned by isotropic noise of the given standard deviation per axis."""
    noise = rng.normal(0, sigma_rad, bearings.shape)
    along = np.einsum("...i,...i->...", noise, bearings)[..., None] * bearings
    return unit(bearings + noise - along)


def loop_walk(num_frames: int, radius: float = 4.0) -> np.ndarray:
    """World_T_rigs (F, 4, 4) of a walk once around, heading along the path with a little sway."""
    around = 2 * np.pi * np.arange(num_frames) / num_frames
    sway = np.column_stack([0.05 * np.sin(3 * around), around, 0.04 * np.cos(2 * around)])
    height = 0.2 * np.sin(2 * around)
    positions = np.column_stack([radius * np.cos(around), height, radius * np.sin(around)])
    return pose(Rotation.from_rotvec(sway).as_matrix(), positions)


def drifted(world_T_rigs: np.ndarray, rng: np.random.Generator, amount: float = 1.0) -> np.ndarray:
    """The walk as SLAM would report it: every step a little off, errors adding up."""
    steps = inverse(world_T_rigs[:-1]) @ world_T_rigs[1:]
    turns = Rotation.from_rotvec(amount * rng.normal(0, np.deg2rad(0.3), (len(steps), 3)))
    steps[:, :3, :3] = steps[:, :3, :3] @ turns.as_matrix()
    stretch = 1 + amount * np.cumsum(rng.normal(0, 0.01, len(steps)))
    sideways = 1 + amount * rng.normal(0, 0.01, (len(steps), 3))
    steps[:, :3, 3] *= stretch[:, None] * sideways
    poses = [world_T_rigs[0]]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.array(poses)


def make_world(
    seed: int,
    num_frames: int = 20,
    num_points: int = 500,
    sigma_rad: float = 5e-4,
    claimed_sigma_rad: float | None = None,
    false_share: float = 0.05,
) -> World:
    """Points in a shell around a loop, each seen from the frames that are near it.

    Args:
        sigma_rad: true noise of bearings per axis.
        claimed_sigma_rad: what keypoints say of it.
        false_share: observations that point anywhere.
    """
    rng = np.random.default_rng(seed)
    world_T_rigs = loop_walk(num_frames)
    near = world_T_rigs[rng.integers(0, num_frames, num_points), :3, 3]
    points = near + rng.uniform(1.5, 6, (num_points, 1)) * unit(rng.normal(size=(num_points, 3)))
    distances = np.linalg.norm(points - world_T_rigs[:, None, :3, 3], axis=2)  # (F, J)
    seen = (distances < 6) & (distances > 0.5) & (rng.random(distances.shape) < 0.8)
    seen &= seen.sum(axis=0) > 1
    frames, which = np.nonzero(seen)
    starts = np.searchsorted(frames, np.arange(num_frames + 1))
    bearings = np.concatenate(
        [bearings_of(points[seen[f]], world_T_rigs[f]) for f in range(num_frames)]
    )
    bearings = with_noise(bearings, sigma_rad, rng)
    false = rng.random(len(bearings)) < false_share
    bearings[false] = unit(rng.normal(size=(false.sum(), 3)))
    keypoints = keypoints_of(starts, bearings, claimed_sigma_rad or sigma_rad)
    tracks, order = tracks_of(which, frames, starts)
    return World(world_T_rigs, points[np.unique(which)], keypoints, tracks, false[order])


def keypoints_of(starts: np.ndarray, bearings: np.ndarray, sigma: float) -> Keypoints:
    """Grey keypoints of one noise (radians) with these bearings (K, 3)."""
    faces, num = owner_faces(bearings), len(bearings)
    grey = np.full((num, 3), 128, np.uint8)
    pixels = RIG.project(bearings, faces)
    return Keypoints(starts, pixels, faces, bearings, np.full(num, sigma), grey)


def tracks_of(
    points: np.ndarray, frames: np.ndarray, starts: np.ndarray
) -> tuple[Tracks, np.ndarray]:
    """Tracks of keypoints (N,), of which each shows a point in a frame, and the keypoint (N,) of
    each observation.

    Args:
        points, frames: (N,) of each keypoint.
        starts: (F + 1,) first keypoint of each frame.
    """
    order = np.lexsort((frames, points))
    _, compact = np.unique(points[order], return_inverse=True)
    tracks = Tracks(
        compact.astype(np.int32),
        frames[order].astype(np.int32),
        (order - starts[frames[order]]).astype(np.int32),
        int(compact.max()) + 1,
    )
    return tracks, order


def features_of(bearings: np.ndarray, descriptors: np.ndarray) -> Features:
    """Features (K) with these bearings (K, 3) and descriptors (K, D)."""
    faces = owner_faces(bearings)
    num = len(bearings)
    return Features(
        RIG.project(bearings, faces),
        faces,
        bearings,
        np.full(num, 1e-3),
        descriptors,
        np.zeros((num, 3), np.uint8),
    )


def context_of(frames: list[Features], settings: RefineSettings) -> MatchContext:
    """Frames that one thread matches, with all their keypoints."""
    searchable = SearchableFrames(frames.__getitem__)
    return MatchContext(searchable, searchable, detection.gather(frames), settings, Threads(1))
