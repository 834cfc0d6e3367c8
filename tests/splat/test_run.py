"""Splats of a run: views, start clouds, training and evaluation from the command line."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import fails, run_gsba, succeed
from refusals import refused
from tiny_run import Case

from gsba.camera.rig import CubeRig
from gsba.camera.views import rig_views
from gsba.evaluate.splats import compare, poses_for
from gsba.geometry import pose
from gsba.splat import from_cloud, read_ply, scene
from gsba.splat.backend import CpuBackend
from gsba.splat.options import TrainingOptions
from gsba.splat.pictures import render_panorama, render_views
from gsba.splat.scores import measure
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

SIX = rig_views(CubeRig(16, np.pi / 2))
TINY = ["--iterations", "30", "--face-size", "32", "--backend", "cpu"]


def call(*arguments: object) -> str:
    return succeed("-q", *arguments).output


@pytest.fixture(scope="module")
def run(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run with a trained splat."""
    out = case.copy(tmp_path_factory.mktemp("splat") / "run")
    call("train", out, *TINY)
    return out


def test_train_writes_a_splat_and_its_metrics(run: Path) -> None:
    splat = read_ply(run / "splat/refined/point_cloud.ply")
    assert len(splat) > 100 and splat.sh_degree == 3
    content = json.loads((run / "splat/results.json").read_text())
    refined = content["sources"]["refined"]
    curve = refined["curve"]
    assert [int(step) for step in curve] == list(range(3, 31, 3))
    assert len(refined["frames"]) == 1 and curve["30"]["psnr"] > curve["3"]["psnr"] + 0.5
    assert content["lpips"].startswith("not computed")
    assert '"name":"splat on refined poses"' in (run / "report.html").read_text()


def test_render_writes_faces_and_a_panorama(run: Path) -> None:
    frame = load_run(run)[1].names[2]
    ply = run / "splat/refined/point_cloud.ply"
    call("render", ply, run, "--frame", frame, "--face-size", 32)
    shapes = {path.name: cv2.imread(str(path)).shape for path in (run / "renderings").iterdir()}
    assert shapes[f"{frame}_erp.png"] == (64, 128, 3)
    assert shapes[f"{frame}_down.png"] == (32, 32, 3) and len(shapes) == 7
    fails(run_gsba("render", ply, run, "--frame", "nonsense"), "no frame 'nonsense'")
    beside = ("--frame", frame, "--out", load_run(run)[1].paths[2][0].parent)
    fails(run_gsba("render", ply, run, *beside), "is the folder of the frames: choose another")


def test_evaluate_compares_sources_and_resumes(case: Case, run: Path, tmp_path: Path) -> None:
    """The same poses in another world and scale are worth the same."""
    found = read_trajectory(run / "trajectory.tum")
    turn = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float)
    places = 3 * found.world_T_rigs[:, :3, 3] @ turn.T + 1
    moved = pose(turn @ found.world_T_rigs[:, :3, :3], places)
    write_tum(tmp_path / "moved.tum", Trajectory(found.timestamps, moved))
    arguments = ("evaluate", run, "--splat", "--against", tmp_path / "moved.tum", *TINY)
    table = call(*arguments)
    content = json.loads((run / "splat-evaluation/results.json").read_text())["sources"]
    psnrs = [content[name]["mean"]["psnr"] for name in ("refined", "moved")]
    assert abs(psnrs[0] - psnrs[1]) < 0.01  # thirty steps: density control has yet to begin
    assert "moved" in table and len(list((run / "splat-evaluation/pictures").iterdir())) == 1
    again = call(*arguments, "--json", tmp_path / "numbers.json")
    assert again == table
    written = json.loads((tmp_path / "numbers.json").read_text())
    assert written["splat"] == content


def test_files_of_one_name_are_not_taken_for_one(run: Path, tmp_path: Path) -> None:
    paths = [tmp_path / name / "slam/a.tum" for name in ("one", "two", "three")]
    for path in paths:
        path.parent.mkdir(parents=True)
        path.write_bytes((run / "trajectory.tum").read_bytes())
    against = [word for path in paths for word in ("--against", path)]
    fails(run_gsba("evaluate", run, "--splat", *against), "another file goes by slam-a, too")


def test_evaluate_needs_something_to_compare_with(run: Path) -> None:
    fails(run_gsba("evaluate", run), "--truth")


@pytest.mark.parametrize(
    "option",
    [("--iterations", "0"), ("--face-size", "3"), ("--backend", "x"), ("--max-gaussians", "0")],
)
def test_bad_options_are_one_line(run: Path, option: tuple[str, str]) -> None:
    fails(run_gsba("train", run, *option), f"error: {option[0]} {option[1]}")


def test_held_out_frames_are_whole_and_spread() -> None:
    usable = np.ones(20, bool)
    usable[3] = False
    split = scene.split_frames(usable)
    assert split.held_out.tolist() == [4, 10, 16] and len(split.training) == 16
    assert not np.isin(3, split.training)
    refused("too few", scene.split_frames, usable[:2])


def test_start_cloud_lies_in_the_world_of_the_poses(case: Case) -> None:
    reconstruction = case.result.reconstruction
    poses = reconstruction.world_T_rigs
    frames = np.arange(len(poses))
    cloud = scene.start_cloud(reconstruction, poses, frames, 0)
    known = {tuple(np.round(point, 2)) for point in reconstruction.points_world}
    same = [tuple(np.round(point, 2)) in known for point in cloud.means.astype(float)]
    assert len(cloud) > 0.5 * len(known) and np.mean(same) > 0.7
    doubled = poses.copy()
    doubled[:, :3, 3] *= 2
    twice = scene.start_cloud(reconstruction, doubled, frames, 0)
    assert len(twice) == len(cloud) and np.allclose(twice.means, 2 * cloud.means, rtol=1e-3)


def test_poses_are_found_by_time(case: Case) -> None:
    frames = case.result.frames
    part = Trajectory(frames.timestamps[1:3], case.truth.world_T_rigs[1:3])
    poses = poses_for(frames, part)
    assert np.isfinite(poses[1:3]).all() and np.isnan(poses[3:]).all()
    refused("one clock", poses_for, frames, Trajectory(part.timestamps + 1e4, part.world_T_rigs))


def test_a_panorama_shows_what_the_faces_show(run: Path) -> None:
    reconstruction, _ = load_run(run)
    splat = read_ply(run / "splat/refined/point_cloud.ply")
    where, backend = reconstruction.world_T_rigs[0], CpuBackend(1)
    panorama = render_panorama(splat, where, 256, 0.01, backend)
    faces = render_views(splat, where, rig_views(CubeRig(65, np.pi / 2)), 0.01, backend)
    assert np.abs(panorama[64, 128].astype(int) - faces[0][32, 32]).max() < 12  # straight ahead
    assert np.abs(panorama[64, 192].astype(int) - faces[1][32, 32]).max() < 12  # right


def test_a_masked_face_is_left_out() -> None:
    images = np.zeros((6, 16, 16, 3), np.uint8)
    use = np.ones((6, 16, 16), bool)
    use[5] = False
    views = scene.make_views(scene.Faces(SIX, images, use), np.eye(4)[None])
    assert len(views.cameras) == 5 and views.use is None
    nothing = scene.make_views(scene.Faces(SIX, images, np.zeros_like(use)), np.eye(4)[None])
    gaussians = from_cloud(np.ones((2, 3)), np.zeros((2, 3), np.uint8))
    given = gaussians, nothing, TrainingOptions(), 0.01, CpuBackend(1)
    refused("held-out frames are masked", measure, *given)


def test_panoramas_at_one_place_are_scored_apart() -> None:
    images = np.zeros((12, 16, 16, 3), np.uint8)
    images[6:] = 128
    faces = scene.Faces(SIX, images, np.ones((12, 16, 16), bool))
    views = scene.make_views(faces, np.eye(4)[None].repeat(2, 0))
    gaussians = from_cloud(np.full((2, 3), 99.0), np.zeros((2, 3), np.uint8))
    scores = measure(gaussians, views, TrainingOptions(), 0.01, CpuBackend(1))
    assert list(scores) == [0, 1] and scores[0].psnr > scores[1].psnr
    assert scores[1].psnr == pytest.approx(-20 * np.log10(128 / 255), abs=1e-3)


def test_a_splat_is_trained_anew_where_other_frames_are_held_out(
    case: Case, tmp_path: Path
) -> None:
    """Beside poses of fewer frames: a splat of before has seen those held out now."""
    result, frames = case.result.reconstruction, case.result.frames
    level = result.world_T_rigs.copy()
    level[:, :3, :3] = np.eye(3)  # aligned to themselves to the last digit
    result = replace(result, world_T_rigs=level)
    settings = TrainingOptions(iterations=20, face_size=16)
    few = level.copy()
    few[:2] = np.nan
    given = settings, CpuBackend(1)
    alone = compare(result, frames, {"refined": level}, *given, tmp_path / "out")
    beside = {"refined": level, "few": few}
    after = compare(result, frames, beside, *given, tmp_path / "out")
    anew = compare(result, frames, beside, *given, tmp_path / "new")
    assert alone["refined"].frames.keys() != after["refined"].frames.keys()
    assert after["refined"].mean == anew["refined"].mean


def test_too_few_common_frames_are_refused(case: Case, tmp_path: Path) -> None:
    frames = case.result.frames
    sources = {"none": np.full((len(frames), 4, 4), np.nan)}
    settings = TrainingOptions(iterations=2, face_size=16)
    given = case.result.reconstruction, frames, sources, settings, CpuBackend(1)
    refused("too few", compare, *given, tmp_path / "out")
    assert not (tmp_path / "out").exists()
