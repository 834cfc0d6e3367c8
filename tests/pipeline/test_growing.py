"""Finished runs that grow by recordings, what they refuse, and that nothing is lost on the way."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accuracy import assert_as_accurate
from command import fails, run_gsba, succeed
from growing_home import MAX_ERROR, NUM, SMALL_EXPORTS, GrowingHome
from plain_records import frames_of
from refusals import refused
from tiny_run import PLAIN
from typer.testing import Result
from waiting import until

from gsba import add_recordings, load_run, merge_runs, refine
from gsba.disk import hold_folder
from gsba.export import ExportFormat
from gsba.frames.recordings import combine
from gsba.localization import Localizer
from gsba.pipeline.finished_run import FinishedRun, KeptMap
from gsba.pipeline.growing import complete
from gsba.similarity import Sim3
from gsba.store.folder import STAGES
from gsba.store.records import save_record
from gsba.store.store import RunStore, load_stage
from gsba.types import FrameSet, PictureFormat, VerifiedPairs
from gsba.view import load_scene


@pytest.fixture(scope="module")
def home(growing_home: GrowingHome) -> GrowingHome:
    return growing_home


@pytest.fixture(scope="module")
def grown(home: GrowingHome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The second recording added from the command line, the finished run left as it is."""
    out = tmp_path_factory.mktemp("grown") / "run"
    before = _content(home.run)
    result = _gsba("add", home.run, home.folders[1], home.trajectories[1], "--out", out)
    assert result.exit_code == 0, result.output
    assert f"{2 * NUM} of {2 * NUM} frames refined" in result.output
    assert _content(home.run) == before
    return out


def _gsba(*arguments: object) -> Result:
    return run_gsba("--quiet", *arguments)


def _content(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Times and content of all files of a folder."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes())
        for path in paths
    }


def test_an_added_recording_is_as_good_as_a_joint_solution(grown: Path, home: GrowingHome) -> None:
    """Which test_recordings.py makes of the same pictures."""
    reconstruction, frames = load_run(grown)
    assert reconstruction.num_maps == 1
    assert frames.names[0] == "ground/000000" and frames.names[NUM] == "upper/000000"
    assert home.error(grown) < MAX_ERROR
    seen_by_both = np.zeros((len(reconstruction.points_world), 2), bool)
    owners = reconstruction.observation_frames // NUM
    seen_by_both[reconstruction.observation_points, owners] = True
    assert seen_by_both.all(axis=1).mean() > 0.2


def test_only_the_new_recording_is_extracted_and_aligned(grown: Path) -> None:
    stages = {
        stage["name"]: stage for stage in json.loads((grown / "report.json").read_text())["stages"]
    }
    assert {"registered", "across", "joined", "align1", "reconstruction"} <= set(stages)
    assert not {"features", "neighbours", "steps"} & set(stages)


def test_a_grown_run_needs_no_other_run(grown: Path, home: GrowingHome, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(grown, tmp_path / "moved"))
    text = (moved / "gsba.json").read_text() + (moved / "report.json").read_text()
    assert ".growing" not in text and str(home.run) not in text
    _, frames = load_run(moved)
    inside = [path for group in frames.paths for path in group if home.run in path.parents]
    assert not inside
    assert not any(path and ".growing" in str(path) for path in frames.mask_paths)


def test_pictures_of_both_lenses_of_a_video_are_kept(tmp_path: Path) -> None:
    """Which have one name, in a folder for each lens in the run that extracted them."""
    first, paths = tmp_path / "first", list[Path]()
    for lens in ("front", "back"):
        paths.append(first / "frames" / lens / "000000.jpg")
        paths[-1].parent.mkdir(parents=True)
        paths[-1].write_text(lens)
    kind = PictureFormat("erp", 512, 256)
    frames = combine({"walk": frames_of(kind, [tuple(paths)] * 2, names=["000000", "000001"])})
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        store.stage("frames", [], lambda: frames, FrameSet)
        complete(store, frames, [first, store.root], store.root)
    kept = load_stage(tmp_path / "run", "frames", FrameSet).paths[0]
    assert [path.read_text() for path in kept] == ["front", "back"]
    assert all(tmp_path / "run" in path.parents for path in kept)


def test_report_exports_and_viewer_tell_recordings_apart(grown: Path) -> None:
    report = json.loads((grown / "report.json").read_text())
    assert [one["name"] for one in report["recordings"]] == ["ground", "upper"]
    assert any(note.startswith("recording upper: joined by points") for note in report["notes"])
    images = {path.name.split("_")[1] for path in (grown / "colmap-flat/images").glob("*.jpg")}
    assert images == {"ground", "upper"}
    assert {path.name for path in (grown / "trajectories").iterdir()} == {"ground.tum", "upper.tum"}
    assert list(load_scene(grown).frames.recordings) == ["ground", "upper"]
    assert (grown / ExportFormat.TUM.value).is_dir()


def test_pictures_are_localised_in_a_grown_run(grown: Path, home: GrowingHome) -> None:
    found = Localizer(grown).localize(home.folders[1] / "000003.jpg")
    assert found.found
    pose = load_run(grown)[0].world_T_rigs[NUM + 3]
    assert np.linalg.norm(found.world_T_rig[:3, 3] - pose[:3, 3]) < 0.02


def test_a_recording_of_another_place_is_refused(home: GrowingHome, tmp_path: Path) -> None:
    before, out = _content(home.run), tmp_path / "run"
    result = _gsba("add", home.run, home.elsewhere, home.elsewhere_trajectory, "--out", out)
    assert result.exit_code == 1 and not out.exists()
    assert "recording 'elsewhere' does not meet the map of" in result.output
    assert _content(home.run) == before and not list(tmp_path.iterdir())


def test_refusals_are_one_line_and_leave_the_run(home: GrowingHome, tmp_path: Path) -> None:
    before = _content(home.run)
    unfinished = Path(shutil.copytree(home.run, tmp_path / "unfinished"))
    (unfinished / "report.json").unlink()
    older = Path(shutil.copytree(home.run, tmp_path / "older"))
    marker = json.loads((older / "gsba.json").read_text())
    (older / "gsba.json").write_text(json.dumps(marker | {"gsba": "0.0.1"}))
    copied = shutil.copytree(home.folders[0], tmp_path / "copied")
    cases = [
        ([home.run], "give the RECORDING to add"),
        ([home.run, copied], "hold the same pictures"),
        ([home.folders[0], home.folders[1]], "is not a gsba run"),
        ([unfinished, home.folders[1]], "is not finished"),
        ([older, home.folders[1]], "is a run of gsba 0.0.1"),
        ([home.run, home.folders[0]], "has recording"),
        ([home.run, "--recording", f"{home.folders[1]},name=ground"], "named 'ground'"),
        ([home.run, home.folders[1], "--out", home.folders[0]], "exists: choose another --out"),
        ([home.run, home.folders[1], tmp_path / "missing.tum"], "missing.tum"),
    ]
    for arguments, told in cases:
        fails(_gsba("add", *arguments), told)
    lock = hold_folder(home.run)
    try:
        assert "in use by another gsba process" in _gsba("add", home.run, home.folders[1]).output
    finally:
        os.close(lock)
    assert _content(home.run) == before


@pytest.mark.slow
def test_a_killed_call_leaves_the_run_and_goes_on(
    home: GrowingHome, grown: Path, tmp_path: Path
) -> None:
    """Killed while features are extracted, and again once the recording is registered."""
    run = Path(shutil.copytree(home.run, tmp_path / "run"))
    before, work = _content(run), tmp_path / ".run.growing"
    words = ["add", str(run), str(home.folders[1]), str(home.trajectories[1])]
    command = [sys.executable, "-c", "from gsba.cli import main; main()", *words]
    for stage in ("new/stages/features", "stages/registered.npz"):
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        until((work / stage).exists, 120)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert _content(run) == before
    succeed(*words)
    again = (run / "trajectory.tum").read_bytes()
    assert again == (grown / "trajectory.tum").read_bytes()
    assert _content(tmp_path / "run-before") == before
    assert {path.name for path in tmp_path.iterdir()} == {"run", "run-before"}
    refused("already, as 'upper'", add_recordings, run, [home.recording()])


@pytest.fixture(scope="module")
def second_run(home: GrowingHome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the second recording alone."""
    out = tmp_path_factory.mktemp("second") / "run"
    refine(home.folders[1], home.trajectories[1], out, SMALL_EXPORTS)
    return out


def test_merged_runs_are_as_good_as_a_grown_one(
    home: GrowingHome, second_run: Path, tmp_path: Path
) -> None:
    before, out = _content(home.run) | _content(second_run), tmp_path / "run"
    result = _gsba("merge", home.run, second_run, "--out", out)
    assert result.exit_code == 0, result.output
    assert home.error(out) < MAX_ERROR  # its ratio to that of `grown` scatters by a fifth
    assert _content(home.run) | _content(second_run) == before


def test_maps_are_tied_where_no_two_frames_share_enough_points(
    home: GrowingHome, second_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = VerifiedPairs.none()
    monkeypatch.setattr("gsba.matching.correspondences.match_across", lambda *_: nothing)
    merge_runs([home.run, second_run], tmp_path / "run")
    assert home.error(tmp_path / "run") < MAX_ERROR


def test_rigid_merging_keeps_both_maps_and_tells_how_sure_it_is(
    home: GrowingHome, second_run: Path, tmp_path: Path
) -> None:
    doubted = Path(shutil.copytree(second_run, tmp_path / "doubted"))
    kept = load_stage(doubted, "map", KeptMap)
    kept = replace(kept, order_doubted=True, lone_steps=(("000003", "000004"),))
    kept = replace(kept, unusable=("black",))
    save_record(doubted / STAGES / "map.npz", kept, {})
    result = merge_runs([home.run, doubted], tmp_path / "run", rigid=True)
    assert result.report["verdict"]["figures"]["position_error"] < 0.01
    reasons = result.report["verdict"]["reasons"]  # those of the second run, too
    assert any("hardly more alike than any two" in reason["cause"] for reason in reasons)
    (lone,) = (reason for reason in reasons if "own two frames alone" in reason["cause"])
    assert lone["frames"] == ["upper/000003", "upper/000004"]
    (unusable,) = (reason for reason in reasons if "next to nothing" in reason["cause"])
    assert unusable["frames"] == ["upper/black"] == result.report["frame_lists"]["unusable"]
    assert not FinishedRun.load(tmp_path / "run").without(["upper"]).unusable
    first, second = load_run(home.run)[0], load_run(second_run)[0]
    merged = load_run(tmp_path / "run")[0]
    assert merged.world_T_rigs[:NUM].tobytes() == first.world_T_rigs.tobytes()
    (joint,) = result.report["trajectory"]["joints"]
    move = Sim3.of(joint["scale"], np.array(joint["world_T_own"]))
    assert np.allclose(merged.world_T_rigs[NUM:], move.poses(second.world_T_rigs), atol=1e-9)
    covariance = np.array(joint["covariance"])
    assert covariance.shape == (7, 7) and (np.linalg.eigvalsh(covariance) > 0).all()
    assert 1e-6 < np.sqrt(covariance[6, 6]) < 0.01
    assert any("scale" in note and "(sigma" in note for note in result.report["notes"])
    own = np.diagonal(second.pose_covariances, axis1=1, axis2=2)[:, :3]
    moved = np.diagonal(merged.pose_covariances[NUM:], axis1=1, axis2=2)[:, :3]
    assert (moved > own).all()


def test_runs_that_meet_nowhere_are_not_merged(home: GrowingHome, tmp_path: Path) -> None:
    other = tmp_path / "other"
    refine(home.elsewhere, home.elsewhere_trajectory, other, PLAIN)
    before, out = _content(home.run), tmp_path / "run"
    result = _gsba("merge", home.run, other, "--out", out)
    assert result.exit_code == 1 and not out.exists()
    assert "meet nowhere" in result.output
    assert _content(home.run) == before and list(tmp_path.iterdir()) == [other]


def test_a_recording_is_taken_out_again(grown: Path, home: GrowingHome, tmp_path: Path) -> None:
    run = Path(shutil.copytree(grown, tmp_path / "run"))
    result = _gsba("remove", run, "upper")
    assert result.exit_code == 0, result.output
    reconstruction, frames = load_run(run)
    assert list(frames.recordings) == ["ground"] and len(frames) == NUM
    assert set(reconstruction.observation_frames.tolist()) <= set(range(NUM))
    assert_as_accurate(run, home.error(run), home.run, 1.25)
    assert {path.name for path in (run / "trajectories").iterdir()} == {"ground.tum"}
    images = {path.name.split("_")[1] for path in (run / "colmap-flat/images").glob("*.jpg")}
    assert images == {"ground"}
    assert len(load_run(tmp_path / "run-before")[1]) == 2 * NUM
    assert "upper" not in (run / "gsba.json").read_text()
    report = json.loads((run / "report.json").read_text())
    assert report["gauge"].startswith("the world and scale of the run that it started from")


def test_merge_and_remove_refuse_in_one_line(
    home: GrowingHome, grown: Path, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    cases = [
        (["merge", home.run, *out], "two finished runs or more"),
        (["merge", home.run, home.run, *out], "is given twice"),
        (["merge", home.run, grown, *out], "both have recording"),
        (["merge", home.run, tmp_path, *out], "is not a gsba run"),
        (["remove", grown, "attic"], "has no recording 'attic': it has ground, upper"),
        (["remove", grown, "ground", "upper"], "one must stay"),
        (["remove", home.run, "ground"], "has no other recording"),
    ]
    for arguments, told in cases:
        fails(_gsba(*arguments), told)
    assert not (tmp_path / "out").exists()
