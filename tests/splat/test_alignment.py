"""Frames aligned to a splat of the tiny walk."""

import gtsam
import numpy as np
import pytest
from splat_alignment import align_to_splat
from tiny_run import Case

from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.camera.views import rig_views
from gsba.geometry import pose
from gsba.splat.alignment import render_view
from gsba.splat.backend import CpuBackend
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.options import TrainingOptions
from gsba.splat.scene import load_faces, make_views, start_cloud
from gsba.splat.train import near_of, train

BACKEND = CpuBackend(2)


@pytest.fixture(scope="module")
def splat(case: Case) -> Gaussians:
    """A splat of all frames, trained just long enough to show the larger things."""
    settings = TrainingOptions(iterations=300, face_size=48, sh_degree=0, rate_scales=0.02)
    poses = case.result.reconstruction.world_T_rigs
    every = np.arange(len(poses))
    views = make_views(load_faces(case.result.frames, every, 48), poses)
    start = start_cloud(case.result.reconstruction, poses, every, 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsba.splat.train._RATE_COLORS", 0.01)
        return train(start, views, settings, BACKEND)


def test_perturbed_poses_come_back(case: Case, splat: Gaussians) -> None:
    frames, poses = case.result.frames, case.result.reconstruction.world_T_rigs
    near = near_of(poses)
    rng = np.random.default_rng(0)
    moved = np.stack(
        [gtsam.Pose3(p).retract(rng.normal(0, [0.003] * 3 + [0.02] * 3)).matrix() for p in poses]
    )
    alone = align_to_splat(splat, frames, moved, near, BACKEND, (16, 32))
    off = np.stack([moved, alone])[..., :3, 3] - poses[:, :3, 3]
    start, first = np.median(np.linalg.norm(off, axis=-1), axis=1)
    assert first < 0.6 * start


def test_a_view_is_points_on_what_was_rendered() -> None:
    """A wall of opaque Gaussians two units ahead: points lie on it, in its colour."""
    across = np.linspace(-4, 4, 60)
    x, y = np.meshgrid(across, across)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)])
    wall = from_cloud(points, np.full((x.size, 3), 200, np.uint8), 0, opacity=0.99)
    world_T_rig = pose(np.eye(3), np.array([0.1, 0.0, 0.2]))
    view = render_view(wall, world_T_rig, rig_views(CubeRig(32, np.pi / 2)), 0.01, BACKEND)
    assert len(view.grey) > 500
    ahead = (view.points_world - world_T_rig[:3, 3]) @ RIG_R_FACE[0]
    middle = np.abs(ahead[:, 0] / ahead[:, 2]) < 0.9
    assert np.allclose(view.points_world[middle, 2], 2, atol=1e-3)
    assert np.allclose(view.grey[middle], 200 / 255, atol=1e-3)
