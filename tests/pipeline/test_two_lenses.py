"""A rendered walk with a camera of two lenses: found, and better for it than one view point."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from command import run_gsba, succeed
from splat_moves import shorten
from tiny_run import SETTINGS

from gsba.app.runs import camera_so_far
from gsba.bundle.lens_centres import StitchRadius
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.camera.views import lens_views
from gsba.config import PlacementSettings, RefineSettings
from gsba.demo import make_walk
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.evaluate import TrajectoryErrors, evaluate
from gsba.log import GsbaError
from gsba.pipeline import refine
from gsba.pipeline.run import Run
from gsba.placement.placement import place
from gsba.store.finished import load_cameras, load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import FrameSet, PictureFormat
from gsba.view import faces_of, load_scene

pytestmark = pytest.mark.slow

BASELINE, RADIUS, NUM_FRAMES, WIDTH = 0.05, 3.0, 16, 768
WALK_SETTINGS = SETTINGS.model_copy(update={"patches": RefineSettings().patches})


def _through_lenses(scene, world_T_rig: np.ndarray, axis: np.ndarray, shape: tuple[int, int]):
    """A panorama stitched at infinity: each direction from the lens that faces it."""
    halves = []
    for sign in (1, -1):
        lens = world_T_rig.copy()
        lens[:3, 3] += sign * 0.5 * BASELINE * world_T_rig[:3, :3] @ axis
        halves.append(render_erp(scene, lens, *shape))
    ahead = erp_directions(shape[0]) @ axis > 0
    return np.where(ahead[..., None], *halves)


def _fixed(scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """The lenses look as the panorama does."""
    return _through_lenses(scene, world_T_rig, np.array([0.0, 0, 1]), (width, height))


def _stabilised(scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """The lenses look along the walk, a little down, below a panorama that keeps its heading."""
    positions = walk_poses("rectangle", "locked", NUM_FRAMES, 0).world_T_rigs[:, :3, 3]
    f = int(np.linalg.norm(positions - world_T_rig[:3, 3], axis=1).argmin())
    ahead = positions[(f + 1) % NUM_FRAMES] - positions[f - 1]
    axis = world_T_rig[:3, :3].T @ ahead / np.linalg.norm(ahead) + np.array([0, 0.1, 0])
    return _through_lenses(scene, world_T_rig, axis / np.linalg.norm(axis), (width, height))


def _stitched(scene, world_T_rig: np.ndarray, width: int, height: int) -> np.ndarray:
    """As `_fixed`, stitched so that what is RADIUS away has no parallax between the lenses."""
    halves, directions = [], erp_directions(width)
    for sign in (1, -1):
        centre = np.array([0.0, 0, 0.5 * sign * BASELINE])
        lens = world_T_rig.copy()
        lens[:3, 3] += world_T_rig[:3, :3] @ centre
        seen = render_erp(scene, lens, 2 * width, 2 * height)
        pixels = erp_from_bearings(RADIUS * directions - centre, 2 * width, 2 * height) - 0.5
        halves.append(cv2.remap(seen, *np.float32(np.moveaxis(pixels, -1, 0)), cv2.INTER_LINEAR))
    return np.where(directions[..., 2:] > 0, *halves)


def _walk(out: Path, camera, heading: str):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsba.demo.render.render_erp", camera)
        return make_walk(out, "rectangle", heading, NUM_FRAMES, WIDTH)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory):
    return _walk(tmp_path_factory.mktemp("lenses") / "walk", _fixed, "forward")


def _refine(walk, out: Path, more=None, **camera) -> tuple[dict, TrajectoryErrors]:
    settings = WALK_SETTINGS.model_dump() | {"camera": camera} | (more or {})
    refine(walk.frames_dir, walk.slam_path, out, RefineSettings.model_validate(settings))
    report = json.loads((out / "report.json").read_text())
    errors = evaluate(read_trajectory(out / "trajectory.tum"), read_trajectory(walk.truth_path))
    return report, errors


def test_a_camera_of_two_lenses_is_found_and_gives_the_scale(
    walk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report, errors = _refine(walk, tmp_path / "two", baseline_mm=50.0)
    camera = report["camera"]
    assert camera["taken"] and camera["reason"] == "" and not camera["readout"]["taken"]
    assert camera["seam_band_deg"] == pytest.approx(4.0)  # no pixel shows both lenses
    assert errors.scale * camera["baseline"] == pytest.approx(BASELINE, rel=0.02)
    assert camera["metres_per_unit"] == pytest.approx(errors.scale, rel=0.02)  # 1 unit = 1 m here
    assert any(note.startswith("one map unit is") for note in report["notes"])
    so_far = camera_so_far(tmp_path / "two", [stage["name"] for stage in report["stages"]])
    assert so_far[0].startswith("the two lenses are")
    placed = place(*load_run(tmp_path / "two"), PlacementSettings(length="lens"), (0.05, 0.0))
    assert placed.similarity.scale == pytest.approx(camera["metres_per_unit"])
    assert placed.unit == "m"
    _export_both(tmp_path / "two", errors.scale)
    _train_and_look(tmp_path / "two")
    shorten(monkeypatch, first_steps=30, steps=10)
    small = {"sizes": (24,), "backend": "cpu"}
    again = {"factors": ("bearing", "splat"), "splat": small}
    report, _ = _refine(walk, tmp_path / "two", again, baseline_mm=50.0)
    assert len(report["splat"]) == 1 and report["camera"]["taken"]
    assert next(stage["name"] for stage in report["stages"] if not stage["resumed"]) == "splat"
    _, central = _refine(walk, tmp_path / "one", model="central")
    one = ["export", str(tmp_path / "one"), "--to", "colmap", "--images", "lenses"]
    refused = run_gsba(*one)
    assert refused.exit_code == 1 and "the run has one centre" in refused.output
    assert errors.ate.rmse < 0.1 * central.ate.rmse  # a hundredth
    assert errors.rpe_rotation_deg.rmse < 0.3 * central.rpe_rotation_deg.rmse  # a twentieth


def _export_both(run: Path, scale: float) -> None:
    """Six faces of one centre, or those of one lens each where these are asked for."""
    lenses = load_cameras(run, *load_run(run)).only
    assert 2 * scale * np.linalg.norm(lenses.centre) == pytest.approx(BASELINE, rel=0.02)
    for images, number in (("--images", "lenses"), 10), ((), 6):
        call = ["-q", "export", str(run), "--to", "colmap", "--face-size", "64", *images]
        succeed(*call)
        assert len(list((run / "colmap/images").iterdir())) == number
        centres = {}
        for image in pycolmap.Reconstruction(run / "colmap/sparse/0").images.values():
            centres.setdefault(image.frame_id, []).append(image.projection_center())
        apart = [np.ptp(np.array(found), axis=0) for found in centres.values()]
        lengths = scale * np.linalg.norm(apart, axis=1)
        np.testing.assert_allclose(lengths, BASELINE if number == 10 else 0, rtol=0.02, atol=1e-9)
    wrong = run_gsba("export", run, "--to", "colmap", "--images", "ball")
    assert wrong.exit_code == 1 and "export.images" in wrong.output


def _train_and_look(run: Path) -> None:
    """Splats and the viewer have the faces of one lens each, in its place."""
    reconstruction, frames = load_run(run)
    size = ["--face-size", "32", "--backend", "cpu"]
    splat, name = run / "splat/refined/point_cloud.ply", frames.names[3]
    calls = (["train", str(run), "--iterations", "30"], ["render", str(splat), str(run), "--frame"])
    for call in (calls[0], [*calls[1], name]):
        succeed("-q", *call, *size)
    views = [view.name for view in lens_views(load_cameras(run, reconstruction, frames).only, 32)]
    rendered = {path.name for path in (run / "renderings").iterdir()}
    assert rendered == {f"{name}_{view}.png" for view in [*views, "erp"]} and len(rendered) == 11
    scene = load_scene(run)
    faces = faces_of(scene.frames, 3, False, scene.optics)
    assert [*faces] == views and len({image.shape for image in faces.values()}) == 3


def test_lenses_that_turn_below_a_stabilised_panorama_are_found(tmp_path: Path) -> None:
    walk = _walk(tmp_path / "walk", _stabilised, "locked")
    report, errors = _refine(walk, tmp_path / "two")
    camera = report["camera"]
    assert camera["taken"] and camera["turned_below_panorama"]
    assert any("stabiliser" in note for note in report["notes"])
    assert errors.scale * camera["baseline"] == pytest.approx(BASELINE, rel=0.03)
    _, central = _refine(walk, tmp_path / "one", model="central")
    assert errors.ate.rmse < 0.2 * central.ate.rmse


def test_a_radius_that_features_do_not_show_is_found_from_patches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = _walk(tmp_path / "walk", _stitched, "forward")
    _, found = _refine(walk, tmp_path / "both")
    monkeypatch.setattr(StitchRadius, "on_trial", lambda *_: None)
    report, errors = _refine(walk, tmp_path / "patches")
    radius = report["camera"]["stitch_radius"]
    assert radius["taken"] and not radius["reason"]
    off = radius["inverse"] - errors.scale / RADIUS
    assert abs(off) < 4 * radius["inverse_sigma"] < 0.2 / RADIUS
    assert errors.scale * report["camera"]["baseline"] == pytest.approx(BASELINE, rel=0.02)
    assert errors.ate.rmse < 1.5 * found.ate.rmse


def test_cube_faces_cannot_be_of_two_lenses() -> None:
    one = (Path("a.jpg"),) * 6
    names = ("front", "right", "back", "left", "up", "down")
    frames = FrameSet(("a",), (one,), np.zeros(1), (None,), (PictureFormat("cube", 64, 64, names),))
    settings = RefineSettings.model_validate({"camera": {"model": "two_lens"}})
    with pytest.raises(GsbaError, match="two_lens is for panoramas"):
        Run.begin(None, frames, None, settings)  # type: ignore[arg-type]
