"""Splats and frames of two lenses: each face from its own lens, where that lens was."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from pixels import pixel_centres
from plain_records import frames_of
from scipy.spatial.transform import Rotation
from splat_alignment import align_to_splat

from gsba.camera.lens import Lenses
from gsba.camera.sphere import erp_directions
from gsba.camera.views import ONE_EYE, Optics
from gsba.disk import write_image
from gsba.geometry import pose
from gsba.splat import Gaussians, from_cloud
from gsba.splat.alignment import capture
from gsba.splat.backend import CpuBackend
from gsba.splat.gaussians import concatenate
from gsba.splat.options import TrainingOptions
from gsba.splat.pictures import render_panorama
from gsba.splat.scene import load_faces, make_views
from gsba.splat.scores import mean_score, measure
from gsba.types import PictureFormat

WIDTH, SIZE, NEAR, NUM_FRAMES = 512, 96, 0.01, 2
BACKEND, SETTINGS = CpuBackend(2), TrainingOptions(sh_degree=0)
RNG = np.random.default_rng(0)
FIXED = Lenses(np.array([0.0, 0.01, 0.1]), band_rad=np.deg2rad(3))
AXES = Rotation.from_rotvec(RNG.normal(0, 0.4, (NUM_FRAMES, 3))).as_matrix()
LENSES = {"fixed": FIXED, "turned below the panorama": replace(FIXED, axes=AXES)}
POSES = pose(
    Rotation.from_rotvec(RNG.normal(0, 0.2, (NUM_FRAMES, 3))).as_matrix(),
    RNG.normal(0, 0.2, (NUM_FRAMES, 3)),
)


def _walls(away: float, spacing: float, spread: float) -> Gaussians:
    """Round Gaussians on the walls of a cube, in grey."""
    along = np.arange(-away + spacing / 2, away, spacing)
    u, v = (axis.ravel() for axis in np.meshgrid(along, along))
    walls = [np.insert([u, v], k, side, axis=0).T for k in range(3) for side in (-away, away)]
    points = np.concatenate(walls)
    found = from_cloud(points, np.full((len(points), 3), 128, np.uint8), 0, opacity=0.98)
    return replace(found, log_scales=np.full_like(found.log_scales, np.log(spread)))


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """Grey walls with dots of all colours before them, all so far apart that what is in front does
    not depend on how a camera is turned."""
    dots = _walls(1.5, 0.25, 0.06)
    sh = np.random.default_rng(1).uniform(-1.7, 1.7, dots.sh.shape).astype(np.float32)
    return concatenate([_walls(2.0, 0.12, 0.1), replace(dots, sh=sh)])


@pytest.fixture(scope="module", params=LENSES.values(), ids=list(LENSES))
def taken(request: pytest.FixtureRequest, room: Gaussians, tmp_path_factory):
    """Panoramas of the room, each direction from the lens that faces it; and these lenses."""
    lenses, folder = request.param, tmp_path_factory.mktemp("frames")
    paths = [folder / f"{f}.png" for f in range(NUM_FRAMES)]
    directions = erp_directions(WIDTH)
    for f, path in enumerate(paths):
        axes = np.eye(3) if lenses.axes is None else lenses.axes[f]
        halves = []
        for sign in (1, -1):
            eye = POSES[f] @ pose(np.eye(3), sign * axes @ lenses.centre)
            halves.append(render_panorama(room, eye, WIDTH, NEAR, BACKEND))
        write_image(path, np.where(directions @ axes[:, 2:] > 0, *halves))
    form, files = PictureFormat("erp", WIDTH, WIDTH // 2), [(path,) for path in paths]
    return frames_of(form, files, np.arange(NUM_FRAMES) / 2), lenses


def test_a_splat_looks_like_faces_of_each_lens(taken, room: Gaussians) -> None:
    frames, lenses = taken
    psnrs = []
    for optics in (Optics(lenses), ONE_EYE):
        views = make_views(load_faces(frames, np.arange(NUM_FRAMES), SIZE, optics), POSES)
        psnrs.append(mean_score(measure(room, views, SETTINGS, NEAR, BACKEND).values()).psnr)
    assert psnrs[0] > 33 and psnrs[1] < psnrs[0] - 8


def test_views_stand_where_their_lenses_do(taken) -> None:
    frames, lenses = taken
    views = make_views(load_faces(frames, np.array([1]), SIZE, Optics(lenses)), POSES[[1]])
    axes = np.eye(3) if lenses.axes is None else lenses.axes[1]
    front = POSES[1, :3, 3] + POSES[1, :3, :3] @ axes @ lenses.centre
    places = np.array([camera.face_in_world for camera in views.cameras])
    assert len(places) == 10 and np.allclose(places[0], front)
    apart = np.linalg.norm(places - front, axis=1)
    assert np.allclose(np.sort(apart)[5:], 2 * np.linalg.norm(lenses.centre))
    shapes = [image.shape[:2] for image in views.images]
    assert shapes == [(camera.height, camera.width) for camera in views.cameras]


def test_poses_come_back_by_what_each_lens_sees(taken, room: Gaussians) -> None:
    frames, lenses = taken
    steps = np.random.default_rng(2).normal(0, [0.003] * 3 + [0.01] * 3, (NUM_FRAMES, 6))
    pairs = zip(POSES, steps, strict=True)
    moved = np.stack([gtsam.Pose3(p).retract(step).matrix() for p, step in pairs])
    off = []
    for optics in (Optics(lenses), ONE_EYE):
        found = align_to_splat(room, frames, moved, NEAR, BACKEND, (48,), optics)
        off.append(np.linalg.norm(found[:, :3, 3] - POSES[:, :3, 3], axis=1).max())
    assert off[0] < 4e-3 and off[1] > 10 * off[0]


def test_what_is_blended_has_no_weight(taken) -> None:
    frames, lenses = taken
    captured = capture(frames, np.array([0]), 32, Optics(lenses))
    (weights,) = captured.weights
    assert weights is not None
    for view, weight in zip(captured.views, weights, strict=True):
        pixels = pixel_centres(view.width, view.width)
        rays = view.rays(pixels).reshape(-1, 3)
        own = np.sign(view.centre @ lenses.centre) * rays[:, 2] > 0
        turned = rays if lenses.axes is None else rays @ lenses.axes[0].T
        clear = own & ~lenses.blended(turned, np.zeros(len(rays), int))
        assert np.array_equal(weight.ravel() > 0, clear) and clear.any()
