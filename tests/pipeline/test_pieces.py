"""The command line on trajectories in pieces, on two places at once, and on what cannot be used."""

import csv
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import fails, run_gsba, succeed
from one_gallery import gallery
from scipy.spatial.transform import Rotation
from tiny_run import LIGHT, NUM_FRAMES, Case
from typer.testing import Result

from gsba import load_run
from gsba.camera.rig import CubeRig
from gsba.config import FeatureSettings
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.export import ExportFormat, export
from gsba.geometry import pose, rotation_angle
from gsba.log import GsbaError
from gsba.odometry import tour_steps
from gsba.similarity import Sim3
from gsba.store.store import load_stage
from gsba.trajectory import turning
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.trajectory.joining import PLACES
from gsba.types import FrameSet, PoseStatus, Reconstruction, Trajectory
from gsba.view import load_scene

SCALE = 1.7
MOVE = pose(Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 8.0]))


def _refine(out: Path, frames: Path, *trajectories: Path, options: tuple[str, ...] = ()) -> Result:
    command = ["--quiet", "refine", frames, *trajectories, "--out", out, *options]
    for change in (*LIGHT, 'export.formats=["colmap-flat"]'):
        command += ["--set", change]
    return run_gsba(*command)


def _judge_order_by_little(patch: pytest.MonkeyPatch) -> None:
    """Small pictures and few keypoints, of runs whose order is not the question."""
    patch.setattr(tour_steps, "_FACES", CubeRig(128, np.pi / 2))
    patch.setattr(tour_steps, "_FEATURES", FeatureSettings(max_per_face=150))


def _gsba(*arguments: object) -> Result:
    return run_gsba("--quiet", *arguments)


def _report(out: Path) -> dict:
    return json.loads((out / "report.json").read_text())


def _write(folder: Path, poses: dict[str, Trajectory]) -> list[Path]:
    for name, trajectory in poses.items():
        write_tum(folder / name, trajectory)
    return [folder / name for name in poses]


@pytest.mark.slow
def test_two_files_with_worlds_of_their_own_are_joined(case: Case, tmp_path: Path) -> None:
    slam = read_trajectory(case.slam)
    half, times = NUM_FRAMES // 2, slam.timestamps
    first = Trajectory(times[:half], slam.world_T_rigs[:half])
    second = Trajectory(times[half:], Sim3.of(SCALE, MOVE).poses(slam.world_T_rigs[half:]))
    files = _write(tmp_path, {"a.tum": first, "b.tum": second})
    out = tmp_path / "run"
    result = _refine(out, case.frames, *files)
    assert result.exit_code == 0, result.output
    (joint,) = _report(out)["trajectory"]["joints"]
    assert (joint["first"], joint["last"], joint["how"]) == ("000004", "000007", PLACES)
    assert joint["scale"] == pytest.approx(1 / SCALE, rel=0.05)  # the walk itself drifts
    assert any("begins at 000004" in note for note in _report(out)["notes"])
    case.assert_as_good(out)


ALONE = ("--no-trajectory", "--fps", "2")
OTHERS = 3  # frames of the second place
NAMES = [f"{f:06d}" for f in range(NUM_FRAMES + OTHERS)]


@pytest.fixture(scope="module")
def two_places(case: Case, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """Behind the walk comes its mirror image, which no rigid camera can see there: a run."""
    folder = tmp_path_factory.mktemp("two-places")
    frames = folder / "frames"
    frames.mkdir()
    for path in sorted(case.frames.glob("*.jpg")):
        (frames / path.name).symlink_to(path)
        number = int(path.stem) - (NUM_FRAMES - OTHERS)
        if number >= 0:
            image = cv2.imread(str(path))
            cv2.imwrite(str(frames / f"{NUM_FRAMES + number:06d}.jpg"), image[:, ::-1])
    out = folder / "run"
    with pytest.MonkeyPatch.context() as patch:
        _judge_order_by_little(patch)
        return out, _refine(out, frames, options=ALONE)


def test_of_two_places_the_larger_is_exported_and_the_other_listed(
    case: Case, two_places: tuple[Path, Result]
) -> None:
    out, _ = two_places
    report = _report(out)
    assert report["trajectory"]["maps"] == [NAMES[:NUM_FRAMES], NAMES[NUM_FRAMES:]]
    reasons = {one["cause"]: one["frames"] for one in report["verdict"]["reasons"]}
    (out_of_it,) = [cause for cause in reasons if cause.startswith("no matches tie")]
    assert reasons[out_of_it] == NAMES[NUM_FRAMES:]
    case.assert_as_good(out)
    with (out / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["map"] for row in rows] == ["1"] * NUM_FRAMES + ["2"] * OTHERS
    assert all(int(row["num_observations"]) > 100 for row in rows)
    images = {path.name.split("_")[1] for path in (out / "colmap-flat/images").iterdir()}
    assert images == set(NAMES[:NUM_FRAMES])
    reconstruction, shown = load_run(out)
    assert shown.names == tuple(NAMES[:NUM_FRAMES]) and len(reconstruction.points_world) > 100
    assert reconstruction.observation_frames.max() == NUM_FRAMES - 1


def test_what_is_counted_is_what_is_exported(
    two_places: tuple[Path, Result], tmp_path: Path
) -> None:
    out, result = two_places
    assert result.exit_code == 3
    first, header, *maps = result.stdout.splitlines()[:4]
    assert first.startswith(
        f"{NUM_FRAMES} of {len(NAMES)} frames refined ({OTHERS} in another map)"
    )
    assert header.split()[:5] == ["map", "frames", "steps", "points", "extent"]
    assert [row.split()[:3] for row in maps] == [
        ["1", str(NUM_FRAMES), str(NUM_FRAMES - 1)],
        ["2", str(OTHERS), str(OTHERS - 1)],
    ]
    *reasons, verdict = result.stdout.splitlines()[4:]
    assert f"  gsba export {out} --to colmap --map 2" in reasons
    assert verdict.startswith(f"look at these places: {NUM_FRAMES} of {len(NAMES)} frames are in")
    assert "exit code 3; --allow-partial makes it 0" in result.stderr
    report = _report(out)
    summary, (largest, other) = report["summary"], report["maps"]
    assert (summary["refined"], summary["exported"], summary["maps"]) == (NUM_FRAMES, NUM_FRAMES, 2)
    assert (summary["frames_in_other_maps"], summary["frames_in_no_map"]) == (OTHERS, 0)
    assert largest["spans"] == [[NAMES[0], NAMES[NUM_FRAMES - 1]]]
    assert other["spans"] == [[NAMES[NUM_FRAMES], NAMES[-1]]]
    assert other["reason"] == "no frame of it shares enough points with a frame of another map"
    main, _ = load_run(out)
    assert summary["points"] == largest["points"] == len(main.points_world)
    assert summary["observations"] == len(main.observation_points)
    assert report["trajectory"]["false_steps"] == report["trajectory"]["false_frames"] == []
    again = _refine(out, out.parent / "frames", options=(*ALONE, "--allow-partial"))
    assert again.exit_code == 0 and "exit code" not in again.stderr
    assert again.stdout.splitlines()[0] == first


def test_each_map_is_exported_on_request(two_places: tuple[Path, Result], tmp_path: Path) -> None:
    out, _ = two_places
    other, shown = load_run(out, 2)
    assert shown.names == tuple(NAMES[NUM_FRAMES:])
    for to in ("colmap", "colmap-flat", "colmap-erp", "nerfstudio", "ply", "tum"):
        result = _gsba("export", out, "--to", to, "--map", "2")
        assert result.exit_code == 0
        assert result.stdout.splitlines()[0] == f"{to}: {out / to}-map2"
        folder = out / f"{to}-map2"
        assert json.loads((folder / "transform.json").read_text())["map"] == 2
    images = {path.name.split("_")[1] for path in (out / "colmap-flat-map2/images").iterdir()}
    assert images == set(NAMES[NUM_FRAMES:])
    written = read_trajectory(out / "tum-map2/trajectory.tum")
    np.testing.assert_allclose(written.world_T_rigs, other.world_T_rigs, atol=1e-9)
    assert (out / "colmap-flat/images").is_dir()  # that of the largest map stays
    # The library does the same, of a run read back and of one in memory.
    whole = load_stage(out, "reconstruction", Reconstruction)
    frames = load_stage(out, "frames", FrameSet)
    export(whole, frames, tmp_path / "tum", ExportFormat.TUM, map_number=2)
    texts = [path / "trajectory.tum" for path in (tmp_path / "tum", out / "tum-map2")]
    assert texts[0].read_bytes() == texts[1].read_bytes()
    export(whole, frames, tmp_path / "largest", ExportFormat.TUM)
    largest = read_trajectory(tmp_path / "largest/trajectory.tum")
    assert len(largest.timestamps) == NUM_FRAMES


def test_an_export_goes_without_frames_by_name_and_without_doubted_ones(
    two_places: tuple[Path, Result], tmp_path: Path
) -> None:
    run, out = tmp_path / "run", tmp_path / "tum"
    shutil.copytree(two_places[0], run)

    def exported(*names: str) -> Result:
        words = [word for name in names for word in ("--without", name)]
        return _gsba("export", run, "--to", "tum", "--out", out, *words)

    def number() -> int:
        return len(read_trajectory(out / "trajectory.tum").timestamps)

    assert exported(*NAMES[:2]).exit_code == 0 and number() == NUM_FRAMES - 2
    report = _report(run)
    reasons = [{"leave_out": True, "frames": NAMES[:1]}, {"leave_out": True, "frames": NAMES[-1:]}]
    report["verdict"]["reasons"] = [*reasons, {"leave_out": False, "frames": NAMES[1:3]}]
    (run / "report.json").write_text(json.dumps(report))
    assert exported("doubted", NAMES[1]).exit_code == 0 and number() == NUM_FRAMES - 2
    everything = _gsba("export", run, "--to", "tum", "--without", "doubted", "--map", "2")
    assert everything.exit_code == 0
    other = read_trajectory(run / "tum-map2/trajectory.tum")
    assert len(other.timestamps) == OTHERS - 1
    strange = exported(NAMES[-1])  # of the other map
    assert strange.exit_code == 1 and number() == NUM_FRAMES - 2
    assert strange.stderr == f"error: there is no frame {NAMES[-1]} in the map to leave out\n"
    assert "no frame is left to export" in exported(*NAMES[:NUM_FRAMES]).stderr
    (run / "report.json").unlink()
    assert "its report names no frames to leave out" in exported("doubted").stderr


@pytest.mark.parametrize("number", ["0", "3", "-1"])
def test_a_map_that_there_is_not_is_refused(two_places: tuple[Path, Result], number: str) -> None:
    out, _ = two_places
    result = _gsba("export", out, "--to", "tum", "--map", number)
    assert result.exit_code == 1 and not result.stdout
    message = f"{out} has no map {number}: it has 2, numbered from 1, the largest"
    assert result.stderr == f"error: {message}\n"
    whole = load_stage(out, "reconstruction", Reconstruction)
    frames, folder = load_stage(out, "frames", FrameSet), out.parent / "none"
    with pytest.raises(GsbaError, match=f"reconstruction has no map {number}: it has 2"):
        export(whole, frames, folder, ExportFormat.TUM, map_number=int(number))
    assert not folder.exists()


def test_the_viewer_shows_the_largest_map_where_its_own_export_is(
    two_places: tuple[Path, Result],
) -> None:
    out, _ = two_places
    before = load_scene(out)
    ends = NAMES[NUM_FRAMES], NAMES[-1]
    scaled = ("--scale", "3", "--between", *ends)
    assert _gsba("export", out, "--to", "tum", "--map", "2", *scaled).exit_code == 0
    after = load_scene(out)
    assert after.unit == before.unit
    np.testing.assert_array_equal(
        after.reconstruction.world_T_rigs, before.reconstruction.world_T_rigs
    )
    assert len(after.frames) == NUM_FRAMES


@pytest.mark.parametrize("at_once", [True, False])
def test_a_tripod_gives_rotations_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at_once: bool
) -> None:
    """Proved by neighbours at once, or where a map was tried in vain."""
    _judge_order_by_little(monkeypatch)
    prove = turning.prove
    if not at_once:
        monkeypatch.setattr(turning, "prove", lambda *a: prove(*a) if len(a) == 4 else None)
    frames, num = tmp_path / "frames", 5
    frames.mkdir()
    turns = [[0.1 * np.sin(f), 0.5 * f, 0.05 * np.cos(f)] for f in range(num)]
    rotations, place = Rotation.from_rotvec(turns).as_matrix(), np.array([-4.4, -1.5, 0.0])
    scene, rng = gallery(), np.random.default_rng(0)
    for f, rotation in enumerate(rotations):
        image = render_erp(scene, pose(rotation, place), 512, 256)
        image = image + 2 * rng.standard_normal(image.shape)
        cv2.imwrite(str(frames / f"{f}.png"), np.clip(image[..., ::-1], 0, 255).astype(np.uint8))
    out = tmp_path / "run"
    result = _refine(out, frames, options=("--no-trajectory", "--fps", "1"))
    assert result.exit_code == 3, result.output
    assert "5 of 5 frames refined, rotations only, no points" in result.output
    assert (
        "do not train: all 5 frames are in one map; the camera turned on the spot"
        in (result.stdout.splitlines()[-1])
    )
    assert any("only rotations are refined" in note for note in _report(out)["notes"])
    reconstruction, _ = load_run(out)
    found = reconstruction.world_T_rigs[:, :3, :3]
    relative, true = found[0].T @ found, rotations[0].T @ rotations
    off = rotation_angle(np.swapaxes(relative, 1, 2) @ true)
    assert np.degrees(off).max() < 0.05  # a pixel is 0.7 degrees
    sigmas = np.sqrt(np.diagonal(reconstruction.pose_covariances, axis1=1, axis2=2))
    assert (sigmas[1:, :3] > 0).all() and np.degrees(sigmas[1:, :3]).max() < 0.05
    assert np.isnan(sigmas[:, 3:]).all()
    assert (reconstruction.pose_statuses == PoseStatus.REFINED).all()
    assert len(reconstruction.points_world) == 0


def test_covariances_are_judged_by_the_truth(case: Case, tmp_path: Path) -> None:
    numbers = tmp_path / "numbers.json"
    write_tum(tmp_path / "truth.tum", case.truth)
    command = ["evaluate", case.out, "--truth", tmp_path / "truth.tum", "--json", numbers]
    result = succeed(*command)
    assert "\nabsolute " in result.output
    assert "fixes the pose of 000000 and its distance to 000007" in result.output
    claims = json.loads(numbers.read_text())["consistency"]
    for kind in ("absolute", "consecutive"):
        assert claims[kind]["num"] == NUM_FRAMES - 1
        # What they are worth is the benchmarks' business; a wrong gauge is off by far more.
        assert 0.1 < claims[kind]["rotation"]["value"] < 10
        assert 0.1 < claims[kind]["position"]["value"] < 10


def test_a_trajectory_of_another_video_is_refused(case: Case, tmp_path: Path) -> None:
    other = walk_poses("oval", "forward", 3 * NUM_FRAMES, seed=3)
    times = read_trajectory(case.slam).timestamps
    (path,) = _write(tmp_path, {"o.tum": Trajectory(times, other.world_T_rigs[:NUM_FRAMES])})
    result = _refine(tmp_path / "run", case.frames, path)
    fails(result, "of another recording or on another clock")
    assert not (tmp_path / "run/trajectory.tum").exists()


def test_poses_that_are_all_the_same_are_refused(case: Case, tmp_path: Path) -> None:
    times = read_trajectory(case.slam).timestamps
    (path,) = _write(tmp_path, {"s.tum": Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1)))})
    result = _refine(tmp_path / "run", case.frames, path)
    fails(result, f"all {NUM_FRAMES} poses of the trajectory are identical")


def test_keyframes_go_with_one_trajectory(case: Case, tmp_path: Path) -> None:
    given = (case.slam, case.slam)
    options = ("--keyframes", str(case.slam))
    result = _refine(tmp_path / "run", case.frames, *given, options=options)
    assert result.exit_code == 1 and "keyframes go with one trajectory" in result.stderr


def test_keyframes_of_a_recording_need_its_trajectory(case: Case, tmp_path: Path) -> None:
    one = f"{case.frames},name=walk,keyframes={case.slam}"
    result = run_gsba("refine", "--recording", one, "--recording", case.out, "--out", tmp_path)
    said = "recording 'walk': keyframes .* need the trajectory of the same SLAM run: give both"
    assert result.exit_code == 1 and re.search(said, result.stderr)
