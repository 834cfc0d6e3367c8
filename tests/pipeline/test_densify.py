"""More frames of a video where its map is weak, and datasets without them."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from export_scene import panoramas, reconstruction
from refusals import refused
from video_files import encode, steady

from gsba.bundle.map_strength import MapStrength
from gsba.config import OdometrySettings, RefineSettings, VideoSettings
from gsba.export import ExportFormat, export
from gsba.frames.scan import scan
from gsba.log import GsbaError
from gsba.masks.merging import Choice, choose
from gsba.odometry import Odometry
from gsba.pipeline import densify
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Evidence
from gsba.store.store import RunStore
from gsba.trajectory.files import read_trajectory
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, Counts, FrameSet, PoseSource
from gsba.video import extract

FPS, NUM_VIDEO = 10, 41
SETTINGS = RefineSettings()


def _walk() -> Odometry:
    """Along a line, all frames posed in one map, the seventh of every ten the sharpest."""
    poses = np.tile(np.eye(4), (NUM_VIDEO, 1, 1))
    poses[:, 0, 3] = 0.05 * np.arange(NUM_VIDEO)
    sharpness = np.where(np.arange(NUM_VIDEO) % 10 == 6, 2.0, 1.0)
    return Odometry(
        np.arange(NUM_VIDEO) / FPS,
        poses,
        np.zeros(NUM_VIDEO, np.uint8),
        np.zeros(NUM_VIDEO, np.int32),
        np.zeros(NUM_VIDEO, bool),
        np.ones(NUM_VIDEO),
        np.full(NUM_VIDEO, 100),
        sharpness,
        1.0,
    )


def _prior(num: int, unseen: list[int]) -> Prior:
    poses = np.tile(np.eye(4), (num, 1, 1))
    steps = np.isin(np.arange(num - 1), unseen)
    trust = replace(StepChecks.of_all(poses), unseen_steps=steps)
    return Prior(CoarsePoses(poses, np.full(num, PoseSource.SLAM, np.uint8), 0.0), trust)


def test_steps_that_no_image_shows_are_weak() -> None:
    found = densify.weak_steps(_prior(6, [3]))
    assert np.flatnonzero(found).tolist() == [3]


def test_of_a_map_that_drifts_the_poorer_half_is_weak() -> None:
    sigmas, nobody = np.array([0.01, 0.02, 0.011, 0.012, 0.03]), np.zeros(7, bool)
    counts = Counts(7, 0, "frames")
    for drift, wanted in ((2e-3, [1, 2, 3, 4, 5]), (1e-5, [])):
        strength = MapStrength(sigmas, np.array([drift]), nobody, nobody[1:], None, counts)
        found = densify.weak_steps(replace(_prior(7, []), strength=strength))
        assert np.flatnonzero(found).tolist() == wanted


def test_the_sharpest_of_the_middle_of_a_weak_step_is_fetched() -> None:
    times = np.array([0.0, 1.0, 2.0, 2.1, 4.0])
    rows = densify.rows_between(_walk(), times, np.array([True, False, True, True]), 9)
    assert rows.tolist() == [6, 28]  # between 2 and 2.1 s there is none
    assert densify.rows_between(_walk(), times, np.ones(4, bool), 1).tolist() == [6]
    lost = replace(_walk(), statuses=np.full(NUM_VIDEO, 2, np.uint8))
    assert not len(densify.rows_between(lost, times, np.ones(4, bool), 9))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    pytest.importorskip("av", reason="PyAV is not installed")
    rng = np.random.default_rng(0)
    coarse = [rng.integers(60, 200, (8, 16, 3), np.uint8) for _ in range(NUM_VIDEO)]
    pictures = [cv2.resize(picture, (128, 64)) for picture in coarse]
    return encode(tmp_path / "walk.mp4", (pictures, steady(NUM_VIDEO, 90_000 // FPS)))


def test_frames_are_fetched_until_the_map_is_strong(video: Path, tmp_path: Path) -> None:
    out, asked = tmp_path / "run", list[int]()

    def measure(frames: FrameSet) -> Prior:
        """Weak between the second frame and the third, while these are a second apart."""
        asked.append(len(frames))
        return _prior(len(frames), [1] if frames.timestamps[2] - frames.timestamps[1] > 0.7 else [])

    with RunStore(out, {"frames": video}, False) as store:
        extract(video, out / "frames", VideoSettings(fps=1))
        chosen = scan(out / "frames")
        given = store, video, _walk(), chosen, SETTINGS, measure
        found = densify.fetch_where_weak(*given)
        assert asked == [5, 6]
        assert found.names == ("000000", "000010", "000016", "000020", "000030", "000040")
        assert found.fetched == (False, False, True, False, False, False)
        assert found.chosen().tolist() == [0, 1, 3, 4, 5]
        assert all(path.is_file() for group in found.paths for path in group)
        again = densify.fetch_where_weak(*given)  # taken up, not solved anew
        assert asked == [5, 6] and again.names == found.names and again.paths == found.paths
        none = SETTINGS.model_copy(update={"odometry": OdometrySettings(fetch_rounds=0)})
        assert densify.fetch_where_weak(store, video, _walk(), chosen, none, measure) is chosen


def test_where_the_map_is_weak_is_measured_again_under_other_masks(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, asked = importlib.import_module("gsba.pipeline.refine"), list[bool]()

    def begin(store: RunStore, settings: RefineSettings, chosen: Choice, start: Any) -> FrameSet:
        asked.append(chosen.carrier)
        return start.frames

    def far_enough(*given: object) -> None:
        raise GsbaError("far enough")

    monkeypatch.setattr(module, "compile_ahead", lambda *_: None)
    monkeypatch.setattr(module, "_begin", begin)
    monkeypatch.setattr(module.frontend, "extract", lambda frames: frames)
    solved = SimpleNamespace(prior=_prior(5, []))
    monkeypatch.setattr(module, "_map_features", lambda _: solved)
    monkeypatch.setattr(module, "_attempted", far_enough)
    extract(video, tmp_path / "frames", VideoSettings(fps=1))
    start = module.Start.of(scan(tmp_path / "frames"), Evidence(), SETTINGS)
    for masks in ("none", "auto", "auto"):
        with RunStore(tmp_path / "run", {"frames": video}) as store:
            given = store, SETTINGS, choose(masks), Evidence(), start, video, _walk()
            refused("far enough", module.refine_from, *given)
    assert asked == [False, True]


def test_datasets_go_without_fetched_frames(tmp_path: Path) -> None:
    frames, found = panoramas(tmp_path / "frames"), reconstruction()
    flags = tuple(f == 1 for f in range(len(frames)))
    some = replace(frames, fetched=flags)
    for kept, fetched in ((len(frames) - 1, False), (len(frames), True)):
        out = tmp_path / f"tum{kept}"
        export(found, some, out, ExportFormat.TUM, fetched=fetched)
        assert len(read_trajectory(out / "trajectory.tum").timestamps) == kept
