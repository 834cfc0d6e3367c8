"""Finished stages are taken up: after a second call, a changed setting, a kill, an interrupt."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from tiny_run import NUM_FRAMES, PLAIN, SETTINGS, Case, computed_stages, settings_with

import gsba
from gsba import RunResult
from gsba.bundle import map_strength
from gsba.config import RefineSettings, RoundSettings, WeakFrameSettings
from gsba.log import following
from gsba.matching import correspondences
from gsba.report.time_left import TimeLeft

WITHOUT_PATCHES = settings_with(patches={"rounds": 0})


def test_a_second_call_takes_everything_up(case: Case, tmp_path: Path) -> None:
    out = case.copy(tmp_path / "run")
    (out / "points.ply").unlink()
    again = case.refine(out)
    assert computed_stages(again) == []
    for name in ("trajectory.tum", "poses.csv", "points.ply"):
        assert (out / name).read_bytes() == (case.out / name).read_bytes()


def test_a_run_tells_its_size_and_the_time_left(case: Case, tmp_path: Path) -> None:
    events, left = [], []

    class Reader(TimeLeft):
        def add(self, entry: Mapping[str, Any]) -> None:
            super().add(entry)
            events.append(entry)
            left.append(self.seconds(entry["time"]))

        def note(self) -> str:
            return ""

    with following(Reader()):
        case.refine(case.copy(tmp_path / "run"))
    (size,) = [entry for entry in events if entry["event"] == "run"]
    assert size["frames"] == NUM_FRAMES and size["trajectory"] and not size["raw"]
    stages = {entry["name"]: entry for entry in events if entry["event"] == "done"}
    sizes = {entry["name"]: entry["observations"] for entry in events if entry["event"] == "map"}
    assert sizes["dense"] > 0 and sizes.keys() < stages.keys()
    assert left[events.index(size)][1] > left[-1][1] >= 0.0


def test_a_changed_setting_renews_what_depends_on_it(
    case: Case, plain_run: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(plain_run, tmp_path / "run"))
    exported = settings_with(patches={"rounds": 0}, export={"face_size": 64})
    assert computed_stages(case.refine(out, exported)) == ["export-colmap"]
    (image, *_) = (out / "colmap/images/front").iterdir()
    pixels = cv2.imread(str(image))
    assert pixels is not None and pixels.shape[:2] == (64, 64)
    more = exported.model_copy(update={"rounds": RoundSettings(filters="many")})
    computed = computed_stages(case.refine(out, more))
    assert computed[0] == "chain" and "reconstruction" in computed
    assert not {"frames", "features", "keypoints", "neighbours"} & set(computed)


def test_a_changed_frame_is_extracted_alone(case: Case, tmp_path: Path) -> None:
    frames = Path(shutil.copytree(case.frames, tmp_path / "frames"))
    out, own = tmp_path / "run", replace(case, frames=frames)
    own.refine(out, PLAIN)
    stored = {path: path.stat().st_mtime_ns for path in (out / "stages/features").glob("*.npz")}
    assert len(stored) == NUM_FRAMES
    os.utime(frames / "000003.jpg")
    computed = computed_stages(own.refine(out, PLAIN))
    assert {"features", "neighbours", "reconstruction"} <= set(computed)
    renewed = [path.stem for path, time in stored.items() if path.stat().st_mtime_ns != time]
    assert renewed == ["000003"]


_DEADLY = """
import importlib, itertools, os, signal, sys
from pathlib import Path
from gsba import refine
from gsba.config import RefineSettings
settings, frames, slam, out, module, name, survived = sys.argv[1:]
module = importlib.import_module(module)
real, calls = getattr(module, name), itertools.count(1)
def deadly(*arguments, **options):
    if next(calls) > int(survived):
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments, **options)
setattr(module, name, deadly)
settings = RefineSettings.model_validate_json(settings)
refine(Path(frames), Path(slam), Path(out), settings)
"""


def _kill_in(case: Case, out: Path, module: str, name: str, survived: int = 0) -> None:
    """Run in a process that is killed on a call of a function."""
    path = str(Path(gsba.__file__).parents[1])
    words = [WITHOUT_PATCHES.model_dump_json(), case.frames, case.slam, out, module, name, survived]
    done = subprocess.run(
        [sys.executable, "-c", _DEADLY, *map(str, words)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()


def test_a_killed_run_goes_on_where_it_was(case: Case, plain_run: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    _kill_in(case, out, "gsba.features.detection", "extract", survived=5)
    stored = {path: path.stat().st_mtime_ns for path in (out / "stages/features").glob("0*.npz")}
    assert 3 <= len(stored) < NUM_FRAMES  # two threads may hold one frame each
    _kill_in(case, out, "gsba.matching.correspondences", "match_loops")
    assert all(path.stat().st_mtime_ns == time for path, time in stored.items())
    assert not any((out / name).exists() for name in ("trajectory.tum", "colmap", "report.json"))
    result = case.refine(out, WITHOUT_PATCHES)
    assert computed_stages(result)[0] == "loops"
    assert (out / "trajectory.tum").read_bytes() == (plain_run / "trajectory.tum").read_bytes()
    assert not list(out.rglob("*.partial*")) and not list(out.rglob(".*"))


def test_an_interrupt_leaves_what_is_finished(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    out = case.copy(tmp_path / "run")
    (out / "stages/loops.npz").unlink()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(correspondences, "match_loops", interrupt)
        case.refine(out)
    assert computed_stages(case.refine(out)) == ["loops"]


@pytest.mark.slow
def test_a_weak_map_gets_more_keypoints_and_resumes(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_strength, "MAX_SCALE_SIGMA", 1e-12)
    closer = {"max_drift": 1e-12, "max_per_face": 600, "mode": "measured"}
    settings = SETTINGS.model_copy(update={"weak_frames": WeakFrameSettings(**closer)})
    result = case.refine(case.copy(tmp_path / "run"), settings)
    stages = {stage["name"]: stage for stage in result.report["stages"]}
    dropped = stages["strength"]["counts"][0]["dropped"]
    assert dropped == {"images hold the step far better": NUM_FRAMES - 1}
    assert stages["features"]["resumed"] and not stages["dense_closer"]["resumed"]
    _has_more_points_and_resumes(case, result, settings)


@pytest.mark.slow
def test_a_walk_that_does_not_return_gets_more_keypoints_at_once(
    case: Case, tmp_path: Path
) -> None:
    """Where few matches foretell a weak map: its frames are searched once."""
    closer = {"max_drift": 1e-12, "max_per_face": 600}
    settings = SETTINGS.model_copy(update={"weak_frames": WeakFrameSettings(**closer)})
    result = case.refine(case.copy(tmp_path / "run"), settings)
    names = [stage["name"] for stage in result.report["stages"]]
    assert "expected_drift" in names and "features_closer" not in names
    _has_more_points_and_resumes(case, result, settings)


def _has_more_points_and_resumes(case: Case, result: RunResult, settings: RefineSettings) -> None:
    points = [len(run.reconstruction.points_world) for run in (case.result, result)]
    assert points[1] > 1.2 * points[0]
    assert case.errors(result.out).rpe_rotation_deg.max < 0.1  # ten times what chance leaves
    assert computed_stages(case.refine(result.out, settings)) == []
