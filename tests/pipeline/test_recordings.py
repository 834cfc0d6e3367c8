"""Several recordings of one place in one run, and recordings that cannot be used together."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import run_gsba
from growing_home import MAX_ERROR, NUM, SMALL_EXPORTS, GrowingHome
from tiny_run import LIGHT, computed_stages
from typer.testing import Result

from gsba import Recording, load_run, refine_recordings
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.pipeline.recordings import GivenRecording
from gsba.trajectory.conventions import Convention
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory
from gsba.view import load_scene

SET = (*LIGHT, 'export.formats=["colmap-flat", "tum"]', "export.face_size=64")


def _refine(out: Path, *arguments: object) -> Result:
    command = ["--quiet", "refine", *map(str, arguments), "--out", str(out)]
    return run_gsba(*command, *(word for one in SET for word in ("--set", one)))


@pytest.fixture(scope="module")
def home(growing_home: GrowingHome, tmp_path_factory: pytest.TempPathFactory) -> GrowingHome:
    """The recordings in a folder of their own: a test lays a file beside one."""
    own = tmp_path_factory.mktemp("recordings")
    folders = [Path(shutil.copytree(each, own / each.name)) for each in growing_home.folders]
    return replace(growing_home, folders=(folders[0], folders[1]))


@pytest.fixture(scope="module")
def run(home: GrowingHome, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both recordings refined from the command line, the second one's keys in a file beside it."""
    out = tmp_path_factory.mktemp("recordings-run") / "run"
    beside = home.folders[1].with_suffix(".toml")
    beside.write_text(f'trajectory = "{home.trajectories[1]}"\nmasks = "none"\n')
    try:
        result = _refine(out, home.folders[0], home.trajectories[0], home.folders[1])
    finally:
        beside.unlink()
    assert result.exit_code == 0, result.output
    return out


def test_recordings_are_one_map_with_one_scale(run: Path, home: GrowingHome) -> None:
    reconstruction, frames = load_run(run)
    assert reconstruction.num_maps == 1 and len(frames) == 2 * NUM
    assert frames.names[:2] == ("ground/000000", "ground/000001")
    assert frames.names[NUM] == "upper/000000"
    error = home.error(run)
    alone = [
        evaluate(read_trajectory(run / f"trajectories/{folder.name}.tum"), own)
        for folder, own in zip(home.folders, home.truths, strict=True)
    ]
    assert [one.num_matched for one in alone] == [NUM, NUM]
    assert abs(np.log(alone[0].scale / alone[1].scale)) < 2e-3
    assert error < MAX_ERROR  # as that of a run that grew, see test_growing.py
    assert error < 1.5 * max(one.ate.rmse for one in alone)
    before = evaluate(read_trajectory(home.trajectories[0]), home.truths[0])
    assert error < 0.3 * before.ate.rmse


def test_the_world_is_that_of_the_first_recording(run: Path, home: GrowingHome) -> None:
    found = read_trajectory(run / "trajectories/ground.tum").world_T_rigs
    given = read_trajectory(home.trajectories[0]).world_T_rigs
    extent = np.linalg.norm(np.ptp(given[:, :3, 3], axis=0))
    assert np.linalg.norm(found[:, :3, 3] - given[:, :3, 3], axis=1).max() < 0.05 * extent


def test_the_report_and_exports_tell_recordings_apart(run: Path) -> None:
    report = json.loads((run / "report.json").read_text())
    first, second = report["recordings"]
    assert (first["name"], first["frames"], second["name"]) == ("ground", NUM, "upper")
    assert first["frames_of_maps"] == second["frames_of_maps"] == {"1": NUM}
    assert first["clock"]["verdict"] in ("agrees", "unclear")
    assert any(note.startswith("recording upper: joined by points") for note in report["notes"])
    images = {path.name.split("_")[1] for path in (run / "colmap-flat/images").glob("*.jpg")}
    assert images == {"ground", "upper"}
    with (run / "poses.csv").open() as file:
        assert [row["frame"].partition("/")[0] for row in csv.DictReader(file)].count(
            "upper"
        ) == NUM
    assert '"recordings":["ground","upper"]' in (run / "report.html").read_text()
    assert list(load_scene(run).frames.recordings) == ["ground", "upper"]


def test_a_second_call_resumes(run: Path, home: GrowingHome) -> None:
    recordings = [
        Recording(folder, trajectory, masks="none" if n else "auto")
        for n, (folder, trajectory) in enumerate(zip(home.folders, home.trajectories, strict=True))
    ]
    assert computed_stages(refine_recordings(recordings, run, SMALL_EXPORTS)) == []


@pytest.mark.slow
def test_recordings_with_and_without_a_trajectory_are_joined(
    home: GrowingHome, tmp_path: Path
) -> None:
    recordings = [Recording(home.folders[0]), Recording(home.folders[1], home.trajectories[1])]
    result = refine_recordings(recordings, tmp_path / "run", SMALL_EXPORTS)
    assert len(result.maps) == 1
    first, second = result.report["recordings"]
    assert not first["with_trajectory"] and second["with_trajectory"]
    given = read_trajectory(home.trajectories[1]).world_T_rigs  # the only one that has a world
    found = result.reconstruction.world_T_rigs[NUM:]
    extent = np.linalg.norm(np.ptp(given[:, :3, 3], axis=0))
    assert np.linalg.norm(found[:, :3, 3] - given[:, :3, 3], axis=1).max() < 0.05 * extent


def _refusal(out: Path, *recordings: Recording) -> str:
    with pytest.raises(GsbaError) as told:
        refine_recordings(recordings, out, SMALL_EXPORTS)
    assert not out.exists()
    return str(told.value)


def test_one_recording_twice_is_refused(home: GrowingHome, tmp_path: Path) -> None:
    out = tmp_path / "run"
    first, second = home.folders
    assert "is given twice" in _refusal(out, Recording(first), Recording(first))
    copied = shutil.copytree(first, tmp_path / "copied")
    assert "hold the same pictures" in _refusal(out, Recording(first), Recording(copied))
    names = Recording(first, name="one"), Recording(second, name="one")
    assert "both named 'one'" in _refusal(out, *names)


def test_errors_name_the_recording(home: GrowingHome, tmp_path: Path) -> None:
    out = tmp_path / "run"
    first, second = home.folders
    told = _refusal(out, Recording(first), Recording(second, tmp_path / "missing.tum"))
    assert told.startswith("recording 'upper': ") and "missing.tum" in told


def test_a_trajectory_of_another_recording_is_refused(home: GrowingHome, tmp_path: Path) -> None:
    swapped = read_trajectory(home.trajectories[0]).world_T_rigs[::-1]
    path = tmp_path / "other.tum"
    write_tum(path, Trajectory(home.truths[1].timestamps, swapped))
    recordings = (
        Recording(home.folders[0], home.trajectories[0]),
        Recording(home.folders[1], path),
    )
    with pytest.raises(GsbaError, match="recording 'upper': the images contradict"):
        refine_recordings(recordings, tmp_path / "run", SMALL_EXPORTS)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--recording", "B,foo=3"], "unknown key 'foo'"),
        (["--recording", "B,fps=fast"], "fps = "),
        (["--recording", "trajectory=a.tum"], "with the path first"),
        (["--recording", "B", "--imu", "gyro.csv"], "pass --recording PATH,imu=gyro.csv"),
    ],
)
def test_the_command_refuses_in_one_line(arguments: list[str], told: str, tmp_path: Path) -> None:
    result = _refine(tmp_path / "run", tmp_path, *arguments)
    assert result.exit_code == 1 and told in result.output.strip().splitlines()[-1]
    assert not (tmp_path / "run").exists()


def test_a_recording_may_start_from_metashape(tmp_path: Path) -> None:
    unit, sensor = " ".join(map(str, np.eye(4).ravel())), '<sensor id="0" type="spherical"/>'
    cameras = "".join(
        f'<camera id="{n}" label="{n}" sensor_id="0"><transform>{unit}</transform></camera>'
        for n in range(2)
    )
    content = f"<sensors>{sensor}</sensors><cameras>{cameras}</cameras>"
    path = tmp_path / "cameras.xml"
    path.write_text(f"<document><chunk>{content}</chunk></document>")
    one = GivenRecording.of(Recording(tmp_path, path), "upper", Convention())
    assert list(one.files) == ["upper: frames", "upper: trajectory"]
    assert len(one.trajectories) == 1
