"""A synthetic world seen by two lenses that are read row by row."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import RIG, World, make_world, unit, with_noise

from gsba.bundle import adjustment, triangulation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.camera_adjustment import solve_with_camera
from gsba.bundle.families import Bearings, Families
from gsba.bundle.readout import CameraEstimate, CameraEstimates
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.camera.cameras import Cameras
from gsba.camera.lens import Lenses
from gsba.camera.rig import owner_faces
from gsba.config import CameraSettings, RefineSettings
from gsba.geometry import inverse
from gsba.types import Keypoints, Landmarks, Solution, Tracks

SIGMA = 4e-4
SETTINGS = RefineSettings.model_validate({"solver": {"num_threads": 2}})
INTERVAL_S = 0.5


def seen_through(
    lenses: Lenses | Cameras,
    seed: int = 0,
    world_T_rigs: np.ndarray | None = None,
    num_frames: int = 24,
) -> tuple[World, Keypoints]:
    """A world, and its keypoints as these lenses have them, from poses of its own or these."""
    world = make_world(seed, num_frames, 1200, SIGMA, false_share=0.02)
    if world_T_rigs is not None:
        world = replace(world, world_T_rigs=world_T_rigs)
    rng, tracks = np.random.default_rng(seed + 1), world.tracks
    rows = world.keypoints.rows(tracks)
    rig_T_world = inverse(world.world_T_rigs)[tracks.frames]
    points = world.points_world[tracks.points]
    local = np.einsum("oij,oj->oi", rig_T_world[:, :3, :3], points) + rig_T_world[:, :3, 3]
    bearings = with_noise(unit(lenses.seeing(local, tracks.frames)), SIGMA, rng)
    found = world.keypoints.bearings_rig.copy()
    found[rows[~world.false]] = bearings[~world.false]
    faces = owner_faces(found)
    pixels = RIG.project(found, faces)
    return world, replace(world.keypoints, bearings_rig=found, faces=faces, pixels=pixels)


def motion(world_T_rigs: np.ndarray, readout_s: float, seed: int = 0) -> np.ndarray:
    """Twists (F, 6): the walk's velocity during a readout, and a gait of each frame's own."""
    steps = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
    ahead = np.roll(world_T_rigs[:, :3, 3], -1, 0) - np.roll(world_T_rigs[:, :3, 3], 1, 0)
    moved = np.einsum("fji,fj->fi", world_T_rigs[:, :3, :3], ahead) / (2 * INTERVAL_S)
    own = np.random.default_rng(seed).normal(0, 1, (len(steps) + 1, 6))
    own *= np.repeat([np.deg2rad(0.1), 0.1 * readout_s * float(np.median(steps)) / INTERVAL_S], 3)
    return own + np.hstack([np.zeros_like(moved), readout_s * moved])


def times(num_frames: int) -> np.ndarray:
    return INTERVAL_S * np.arange(num_frames)


def problem_of(world: World, camera: CameraSettings | None = None) -> AdjustmentContext:
    priors = TrajectoryPrior(world.world_T_rigs, SETTINGS.priors)
    settings = SETTINGS.model_copy(update={"camera": camera or SETTINGS.camera})
    return AdjustmentContext(Families((Bearings(), priors)), RIG, settings, 2)


def solved_under(
    world: World, shown: Keypoints, lenses: Lenses, start: Solution
) -> tuple[Solution, Keypoints, Tracks]:
    """The map adjusted with a camera, its rays, and the tracks that this one sees."""
    cameras = Cameras((lenses,))
    keypoints = cameras.seen(shown)
    tracks = cameras.clear(world.tracks, keypoints)
    gates = (30.0, 8.0)
    solved = adjustment.adjust(tracks, keypoints, start, problem_of(world), gates)
    return solved, keypoints, tracks


def solved_with(
    world: World,
    shown: Keypoints,
    camera: CameraEstimate,
    start: Solution,
    problem: AdjustmentContext,
) -> tuple[Solution, CameraEstimate]:
    """Map and camera adjusted together, from the tracks that the camera sees."""
    estimates = CameraEstimates((camera,))
    tracks = estimates.cameras.clear(world.tracks, estimates.cameras.seen(shown))
    given = estimates, times(len(start.world_T_rigs)), start, problem
    solved, found = solve_with_camera(tracks, shown, *given, (30.0, 8.0, 8.0))
    return solved, found.each[0]


def placed(solved: Solution, keypoints: Keypoints, tracks: Tracks) -> Landmarks:
    """Points of all tracks under the solution's poses."""
    rows = keypoints.rows(tracks)
    return triangulation.triangulate(
        tracks, keypoints.bearings_rig[rows], keypoints.sigmas_rad[rows], solved.world_T_rigs,
        30 * solved.noise, 1, keypoints.origins_of(rows), min_parallax_deg=0.3,
    )  # fmt: skip


def turned(vectors: np.ndarray) -> np.ndarray:
    return Rotation.from_rotvec(vectors).as_matrix()
