"""`gsba track` on folders and videos, and the refinement of a video by its own odometry."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import fails, run_gsba, succeed
from dense_walk import RenderedWalk
from tiny_run import LIGHT

from gsba.evaluate.trajectory import evaluate
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

FPS = 10


@pytest.fixture(scope="module")
def folder(walk: RenderedWalk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    for n, frame in enumerate(walk.frames):
        cv2.imwrite(str(folder / f"{n:04d}.png"), frame)
    return folder


@pytest.fixture(scope="module")
def video(walk: RenderedWalk, tmp_path_factory: pytest.TempPathFactory) -> Path:
    av = pytest.importorskip("av", reason="PyAV is not installed")
    path = tmp_path_factory.mktemp("video") / "walk.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "10"})
        stream.height, stream.width = walk.frames[0].shape
        stream.pix_fmt = "yuv420p"
        for frame in walk.frames:
            picture = av.VideoFrame.from_ndarray(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR), "bgr24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return path


def _ate(path: Path, walk: RenderedWalk) -> float:
    truth = Trajectory(np.arange(len(walk.frames)) / FPS, walk.world_T_rigs)
    length = np.linalg.norm(np.diff(walk.world_T_rigs[:, :3, 3], axis=0), axis=1).sum()
    return evaluate(read_trajectory(path), truth).ate.rmse / length


@pytest.mark.parametrize("source", ["folder", "video"])
def test_every_frame_gets_a_pose(
    source: str, walk: RenderedWalk, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    frames, out = request.getfixturevalue(source), tmp_path / "walk.tum"
    times = ["--fps", FPS] if source == "folder" else []
    result = succeed("track", frames, "--out", out, "--masks", "none", *times)
    assert f"{len(walk.frames)} of {len(walk.frames)} frames posed" in result.output
    assert len(read_trajectory(out).timestamps) == len(walk.frames)
    assert _ate(out, walk) < 0.01
    report = json.loads((tmp_path / "walk-report.json").read_text())
    keyframes = read_trajectory(tmp_path / "walk-keyframes.tum")
    assert len(keyframes.timestamps) == report["keyframes"] < len(walk.frames)
    assert report["lost"] == [] and report["maps"] == 1
    with (tmp_path / "walk-poses.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows[1:]] == ["tracked"] * (len(walk.frames) - 1)
    assert sum(int(row["keyframe"]) for row in rows) == report["keyframes"]
    assert {row["map"] for row in rows} == {"1"}
    assert all(float(row["cov_tx_tx"]) > 0 for row in rows)


def test_a_mask_is_used_and_a_false_one_refused(folder: Path, tmp_path: Path) -> None:
    square = tmp_path / "square.png"
    cv2.imwrite(str(square), np.full((64, 64), 255, np.uint8))
    result = run_gsba("track", folder, "--fps", FPS, "--out", tmp_path / "w.tum", "--masks", square)
    assert result.exit_code == 1 and "a mask is 2:1" in result.output
    assert not (tmp_path / "w.tum").exists()


def test_what_is_no_input_is_refused_in_one_line(folder: Path, video: Path, tmp_path: Path) -> None:
    out = tmp_path / "w.tum"
    for arguments, said in (
        ((tmp_path / "none.mp4", "--out", out), "none.mp4"),
        ((folder, "--out", tmp_path), "is a folder"),
        ((video, "--out", out, "--fps", 3), "holds the times of its frames"),
        ((video, "--out", out, "--width", 801), "width"),
    ):
        fails(run_gsba("track", *arguments), said)
    assert not out.exists()


def test_frames_without_poses_are_refused(tmp_path: Path) -> None:
    frames = tmp_path / "noise"
    frames.mkdir()
    for n, noise in enumerate(np.random.default_rng(0).integers(0, 256, (4, 128, 256), np.uint8)):
        cv2.imwrite(str(frames / f"{n}.png"), noise)
    result = run_gsba("track", frames, "--out", tmp_path / "w.tum", "--masks", "none")
    assert result.exit_code == 1 and "poses for fewer than two of 4 frames" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["noise"]


def test_frames_are_extracted_by_what_they_show(video: Path, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    succeed("extract", video, "--every", "auto", "--out", frames)
    chosen = read_trajectory(tmp_path / "frames.tum")
    names = sorted(path.name for path in frames.glob("*.jpg"))
    assert 3 < len(names) == len(chosen.timestamps) < 34
    assert [f"{round(t * FPS):06d}.jpg" for t in chosen.timestamps] == names
    for more in ((), ("--fresh",)):
        again = succeed("extract", video, "--every", "auto", "--out", frames, *more)
        assert f"{len(names)} of" in again.output


def test_a_video_is_refined_from_its_own_odometry(
    video: Path, walk: RenderedWalk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    changes = (*LIGHT, "patches.rounds=0", "features.max_per_face=300")
    light = [word for change in changes for word in ("--set", change)]
    result = succeed("refine", video, "--masks", "none", "--out", out, *light)
    assert (out / "odometry/walk.tum").is_file() and (out / "odometry/poses.csv").is_file()
    assert "Camera path by the odometry on the video" in (out / "report.html").read_text()
    assert '"odometry":{"summary":' in (out / "report.html").read_text()
    report = json.loads((out / "report.json").read_text())
    followed = report["stages"][0]
    assert followed["title"] == "track the video"
    assert report["summary"]["seconds"] > followed["seconds"] > 0
    chosen = read_trajectory(out / "odometry/chosen.tum")
    assert len(list((out / "frames").glob("*.jpg"))) == len(chosen.timestamps)
    assert _ate(out / "trajectory.tum", walk) < 0.005
    monkeypatch.chdir(tmp_path)
    again = succeed("refine", video, "--masks", "none", "--out", "run", *light)
    assert "nothing changed" in again.output
    assert again.output.splitlines()[-1] == result.output.splitlines()[-1]
