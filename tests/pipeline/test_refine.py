"""The whole line on a tiny rendered walk: accuracy, files, odd frames, other inputs."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import gtsam
import numpy as np
import plyfile
import pycolmap
import pytest
from tiny_run import (
    NUM_FRAMES,
    ONE_ROUND,
    SETTINGS,
    WIDTH,
    Case,
    computed_stages,
    exporting,
    settings_with,
)

from gsba import Family, MapSnapshot, refine
from gsba.bundle.pose_variables import X
from gsba.camera.rig import CubeRig
from gsba.config_file import load_config
from gsba.evaluate.trajectory import evaluate
from gsba.export import ExportFormat, export, pictures
from gsba.frames import cubemap
from gsba.log import GsbaError
from gsba.store.finished import load_run
from gsba.store.store import load_stage
from gsba.trajectory.files import read_trajectory
from gsba.types import FACES, Keypoints, PoseStatus, Trajectory

EXPORTED = settings_with(patches={"rounds": 1})  # of runs whose exports are read


def _greyed(case: Case, to: Path, frames: list[int]) -> Path:
    """The walk's frames, some of them without texture."""
    shutil.copytree(case.frames, to)
    for f in frames:
        cv2.imwrite(str(to / f"{f:06d}.jpg"), np.full((WIDTH // 2, WIDTH, 3), 128, np.uint8))
    return to


def _without(trajectory: Trajectory, frame: int) -> Trajectory:
    both = trajectory.timestamps, trajectory.world_T_rigs
    return Trajectory(*(np.delete(x, frame, 0) for x in both))


def test_poses_become_better_by_far(case: Case) -> None:
    before = evaluate(read_trajectory(case.slam), case.truth)
    after = case.errors()
    assert after.num_matched == NUM_FRAMES
    # Thirty times better when written; a tenth leaves room for other settings.
    assert after.ate.rmse < before.ate.rmse / 10
    assert after.rotation_deg.rmse < before.rotation_deg.rmse / 10
    assert after.rpe_rotation_deg.median < before.rpe_rotation_deg.median / 5
    assert (case.result.reconstruction.pose_statuses == PoseStatus.REFINED).all()


def test_every_file_can_be_read(case: Case) -> None:
    reconstruction, out = case.result.reconstruction, case.out
    trajectory = read_trajectory(out / "trajectory.tum")
    np.testing.assert_allclose(trajectory.world_T_rigs, reconstruction.world_T_rigs, atol=1e-7)
    with (out / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frame"] for row in rows] == list(case.result.frames.names)
    assert all(row["status"] == "refined" and int(row["num_observations"]) > 50 for row in rows)
    assert all(float(row["cov_tx_tx"]) > 0 for row in rows)
    vertices = plyfile.PlyData.read(out / "points.ply")["vertex"]
    assert len(vertices) == len(reconstruction.points_world) > 300
    np.testing.assert_allclose(vertices["x"], reconstruction.points_world[:, 0], rtol=1e-5)
    assert load_config(out / "config.toml") == SETTINGS
    model = pycolmap.Reconstruction(out / "colmap/sparse/0")
    assert (model.num_frames(), model.num_images()) == (NUM_FRAMES, 6 * NUM_FRAMES)
    assert model.num_points3D() == len(reconstruction.points_world)
    assert len(list((out / "colmap/images").rglob("*.jpg"))) == 6 * NUM_FRAMES


def test_the_report_tells_what_happened(case: Case) -> None:
    report = json.loads((case.out / "report.json").read_text())
    summary = report["summary"]
    assert (summary["frames"], summary["refined"]) == (NUM_FRAMES, NUM_FRAMES)
    assert 0 < summary["median_residual_deg"] < summary["median_residual_deg_coarse"]
    assert report["notes"] == [] and report["start"] == "trajectory file"
    assert report["verdict"]["sentence"].startswith("good to train: all 8 frames are in one map")
    stages = {stage["name"]: stage for stage in report["stages"]}
    assert {"features", "neighbours", "chain", "reconstruction", "export-colmap"} <= stages.keys()
    assert all(stage["seconds"] >= 0 and stage["peak_mb"] > 0 for stage in stages.values())
    counts = [counted for stage in stages.values() for counted in stage["counts"]]
    assert len(counts) > 10
    for counted in counts:  # whatever is dropped has a reason
        assert counted["received"] == counted["kept"] + sum(counted["dropped"].values()), counted
    names = ("fetched", "interpolated", "unmatched", "weighted_down", "uncertain_scale", "unusable")
    assert report["frame_lists"] == {name: [] for name in names}
    first = report["solver"][0]["rounds"][0]["iterations"]
    assert first[-1]["cost"] < first[0]["cost"] and "bearing" in first[0]["costs"]


@pytest.fixture(scope="module")
def blank(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Case:
    """The walk with frame 3 grey."""
    folder = tmp_path_factory.mktemp("unusable")
    frames = _greyed(case, folder / "frames", [3])
    result = refine(frames, case.slam, folder / "run", ONE_ROUND)
    return replace(case, frames=frames, out=folder / "run", result=result)


def test_a_blank_frame_keeps_a_pose_and_is_reported(blank: Case) -> None:
    result, statuses = blank.result, blank.result.reconstruction.pose_statuses
    expected = np.full(NUM_FRAMES, PoseStatus.REFINED)
    expected[3] = PoseStatus.UNREFINED
    np.testing.assert_array_equal(statuses, expected)
    assert result.report["frames"][3]["status"] == "unrefined"
    verdict = result.report["verdict"]
    assert verdict["level"] == "look at these places" and not result.failed
    assert "hardly any matches: the pose is that of the trajectory file" in [
        one["cause"] for one in verdict["reasons"] if "000003" in one["frames"]
    ]
    before, after = (
        evaluate(_without(read_trajectory(path), 3), _without(blank.truth, 3))
        for path in (blank.slam, blank.out / "trajectory.tum")
    )
    assert after.ate.rmse < before.ate.rmse / 10
    # The frame itself is where the trajectory's steps from its neighbours put it.
    before, after = evaluate(read_trajectory(blank.slam), blank.truth), blank.errors()
    assert after.num_matched == NUM_FRAMES and after.ate.max < before.ate.max


def test_a_destroyed_picture_ends_the_run_by_name(case: Case, tmp_path: Path) -> None:
    """And the run goes on where it stopped once the picture is whole or gone."""
    frames, out = tmp_path / "frames", tmp_path / "run"
    shutil.copytree(case.frames, frames)
    whole = (frames / "000005.jpg").read_bytes()
    (frames / "000005.jpg").write_bytes(whole[:-9000] + bytes(3000) + whole[-6000:])
    with pytest.raises(GsbaError, match=r"000005\.jpg: damaged \("):
        refine(frames, case.slam, out, EXPORTED)
    assert not (out / "trajectory.tum").exists() and not (out / "colmap").exists()
    (frames / "000005.jpg").write_bytes(whole)
    kept = {path.stem for path in (out / "stages" / "features").glob("*.npz")}
    assert kept and "000005" not in kept
    result = refine(frames, case.slam, out, EXPORTED)
    assert (result.reconstruction.pose_statuses == PoseStatus.REFINED).all()


def test_dark_frames_are_said_to_be_dark(case: Case, tmp_path: Path) -> None:
    """A camera of 12 bits, written as they are into 16."""
    (tmp_path / "frames").mkdir()
    for path in sorted(case.frames.glob("*.jpg"))[:4]:
        image = cv2.imread(str(path))
        twelve = image.astype(np.uint16) * 16
        assert cv2.imwrite(str(tmp_path / "frames" / f"{path.stem}.png"), twelve)
    with pytest.raises(GsbaError, match=r"no two .* very dark \(99 % of their pixels at or below"):
        refine(tmp_path / "frames", case.slam, tmp_path / "run", SETTINGS, fps=2)


def test_cube_faces_serve_as_well(case: Case, tmp_path: Path) -> None:
    """Of all six, see test_several_cameras.py; here without those above and below."""
    missing = "up", "down"
    rig = CubeRig(WIDTH // 3, np.pi / 2)  # the panorama's own density
    frames = tmp_path / "frames"
    for path in sorted(case.frames.glob("*.jpg")):
        faces = cubemap.cut(cv2.imread(str(path)), rig)
        for name, image in zip(FACES, faces, strict=True):
            if name not in missing:
                (frames / name).mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(frames / name / f"{path.stem}.png"), image)
    shutil.copy(case.frames / "timestamps.csv", frames)
    out = tmp_path / "run"
    result = refine(frames, case.slam, out, EXPORTED)
    assert (result.reconstruction.pose_statuses == PoseStatus.REFINED).all()
    keypoints = load_stage(out, "keypoints", Keypoints)
    assert not {FACES.index(name) for name in missing} & set(keypoints.faces)
    before = evaluate(read_trajectory(case.slam), case.truth)
    assert case.errors(out).ate.rmse < before.ate.rmse / 10
    model = pycolmap.Reconstruction(out / "colmap/sparse/0")
    assert model.num_images() == (6 - len(missing)) * NUM_FRAMES


def test_formats_added_later_are_written_together(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, read, load = case.copy(tmp_path / "run"), [], pictures.load_padded
    monkeypatch.setattr(
        pictures, "load_padded", lambda frames, f, *a: read.append(f) or load(frames, f, *a)
    )
    settings, new = exporting("colmap", "colmap-flat", "nerfstudio"), "export-nerfstudio"
    assert computed_stages(case.refine(out, settings)) == ["export-colmap-flat", new]
    assert sorted(read) == list(range(NUM_FRAMES))
    for f in range(NUM_FRAMES):
        (name,) = [p.name for p in (out / "colmap/images/front").glob(f"*{f:04d}.*")]
        stem, _, suffix = name.rpartition(".")
        wanted = (out / "colmap/images/front" / name).read_bytes()
        for images, name in (
            (out / "colmap-flat/images", f"*_{stem}_front.{suffix}"),
            (out / "nerfstudio/images", f"{stem}_front.{suffix}"),
        ):
            (path,) = images.glob(name)
            assert path.read_bytes() == wanted
    shutil.rmtree(out / "nerfstudio")
    assert computed_stages(case.refine(out, settings)) == [new]
    assert (out / "nerfstudio/transforms.json").is_file()


def test_datasets_of_an_earlier_map_are_named(
    case: Case, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    out, said = case.copy(tmp_path / "run"), "colmap holds a map of an earlier call"
    export(*load_run(out), out / "mine", ExportFormat.TUM)
    case.refine(out, exporting("nerfstudio"))  # of the same map
    assert "of an earlier call" not in caplog.text
    case.refine(out, exporting("nerfstudio").model_copy(update={"seed": 7919}))
    assert said in caplog.text and "nerfstudio holds" not in caplog.text
    assert f"(gsba export {out} --to tum --out {out / 'mine'})" in caplog.text


def test_masks_reach_features_and_exports(case: Case, tmp_path: Path) -> None:
    mask = np.full((WIDTH // 2, WIDTH), 255, np.uint8)
    mask[WIDTH // 3 :] = 0  # nothing steeper than 30 degrees down: not even a face's corners
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    out = tmp_path / "run"
    result = case.refine(out, EXPORTED, masks=tmp_path / "mask.png")
    pixel = 2 * np.pi / WIDTH
    down = np.sin(np.pi / 6 + 2 * pixel)
    assert load_stage(out, "keypoints", Keypoints).bearings_rig[:, 1].max() < down
    assert load_stage(case.out, "keypoints", Keypoints).bearings_rig[:, 1].max() > down
    assert (result.reconstruction.pose_statuses == PoseStatus.REFINED).all()
    written = sorted((out / "colmap/masks").rglob("*.png"))
    assert len(written) == 6 * NUM_FRAMES
    shares = {path.parent.name: (cv2.imread(str(path), 0) > 127).mean() for path in written}
    assert shares["down"] == 0 and shares["up"] == 1


class _Height(Family):
    """A height for the blank frame, of which images say nothing."""

    name = "height"

    def __init__(self, height: float) -> None:
        self.height, self.digest = height, str(height)

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list | None):
            world_T_rig = values.atPose3(X(3))
            if jacobians is not None:
                jacobians[0] = np.append(np.zeros(3), world_T_rig.rotation().matrix()[1])[None]
            return np.array([world_T_rig.y() - self.height])

        graph = gtsam.NonlinearFactorGraph()
        noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-4)
        graph.add(gtsam.CustomFactor(noise, [X(3)], error))
        return graph


def test_a_family_of_ones_own_takes_part(blank: Case, tmp_path: Path) -> None:
    lift, out = 0.1, blank.copy(tmp_path / "run")
    height = blank.result.coarse.world_T_rigs[3, 1, 3] + lift
    result = blank.refine(out, ONE_ROUND, families=[_Height(height)])
    assert "chain" in computed_stages(result) and "features" not in computed_stages(result)
    heights = result.reconstruction.world_T_rigs[:, 1, 3]
    # Moving the solution back into the trajectory's world shifts heights by the drift it removed.
    assert heights[3] == pytest.approx(height, abs=0.02)
    plain = blank.result.reconstruction.world_T_rigs[:, 1, 3]
    assert np.abs(np.delete(heights - plain, 3)).max() < 1e-3 < heights[3] - plain[3]
    assert not computed_stages(blank.refine(out, ONE_ROUND, families=[_Height(height)]))
    other = blank.refine(out, ONE_ROUND, families=[_Height(height + lift)])
    assert "chain" in computed_stages(other)
