"""Worlds of runs of several maps that grow or shrink: what holds in one does not hold in others."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from command import fails, run_gsba
from plain_records import frames_of, map_of
from synthetic import loop_walk, make_world

from gsba import Recording
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import LensCentres
from gsba.bundle.readout import CameraEstimate
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings, RefineSettings
from gsba.frames.recordings import combine
from gsba.pipeline import growing
from gsba.pipeline.each_recording import joined_poses
from gsba.pipeline.finished_run import FinishedRun
from gsba.pipeline.joint_cameras import JointCameras
from gsba.pipeline.joint_map import JointMaps
from gsba.pipeline.map import Map
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Evidence, Run
from gsba.pipeline.state import State
from gsba.similarity import Sim3
from gsba.store.store import RunStore
from gsba.types import (
    CoarsePoses,
    Counts,
    FrameSet,
    Landmarks,
    PictureFormat,
    PoseSource,
    Reconstruction,
    Solution,
)

SMALL, LARGE, NEW = 3, 5, 6  # frames of the run's two maps, and of a recording
NUM = SMALL + LARGE
UP, ORIGIN = np.array([0.0, -1.0, 0.0]), np.array([4e5, 5e6, 100.0])  # of the run's largest map


def _frames(sizes: dict[str, int]) -> FrameSet:
    names = tuple(f"{name}/{f}" for name, num in sizes.items() for f in range(num))
    frames = frames_of(PictureFormat("erp", 512, 256), [(Path(name),) for name in names])
    return replace(frames, names=names, clock_shifts=(0.0,) * len(names))


def _result(poses: np.ndarray, components: np.ndarray) -> Reconstruction:
    none, several = np.zeros(0, np.int64), components if components.any() else None
    nothing = np.zeros((0, 3))
    return map_of(poses, nothing, none, none, nothing, components=several)


def _run(frames: FrameSet, result: Reconstruction, map_: Map | None = None) -> FinishedRun:
    poses = result.world_T_rigs
    coarse = CoarsePoses(poses, np.full(len(poses), PoseSource.SLAM, np.uint8), 0.0)
    map_ = map_ or Map(Solution.without_points(poses), cast(Any, None), np.ones(len(poses)))
    files = (Path("none"),) * len(poses)
    settings = RefineSettings(), files, (CameraSettings(),)
    return FinishedRun(Path("run"), {}, frames, map_, coarse, result, *settings)


def _maps() -> JointMaps:
    """A run of two maps, the smaller one first, and a recording that is added to it."""
    poses, nothing = loop_walk(NUM + NEW), cast(Any, None)
    own = Sim3(2.0, translation=np.array([9.0, 0, 0])).poses(poses[:SMALL])  # in its own world
    maps_before = np.repeat([1, 0], [SMALL, LARGE])
    first = _result(np.concatenate([own, poses[SMALL:NUM]]), maps_before)
    first = replace(first, vertical=UP, origin=ORIGIN)
    new = _result(poses[NUM:], np.zeros(NEW, int))
    runs = _run(_frames({"old": NUM}), first), _run(_frames({"new": NEW}), new)
    frames, parts = _frames({"old": NUM, "new": NEW}), np.repeat([1, 0, 2], [SMALL, LARGE, NEW])
    return JointMaps(runs, (), (0, NUM, NUM + NEW), frames, nothing, parts, nothing)


def _joined(components: np.ndarray) -> State:
    """The maps once they were joined, by the new map (F,) of each frame."""
    poses, nothing = loop_walk(NUM + NEW), cast(Any, None)
    start = CoarsePoses(poses, np.full(len(poses), PoseSource.SLAM, np.uint8), 0.0)
    given = [*[nothing] * 3, _maps().frames, start, nothing, RefineSettings(), *[nothing] * 6]
    merged = cast(Any, SimpleNamespace(components=components, reasons=()))
    parts = components if components.any() else None
    prior = replace(Prior.of(start), parts=parts, merged=merged)
    return State(replace(Run(*given), evidence=Evidence()), prior, *[nothing] * 4)


@pytest.mark.parametrize("joined_to_largest", [True, False])
def test_vertical_and_origin_stay_with_the_map_that_they_are_of(
    joined_to_largest: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map that the recording is joined to is the largest then."""
    components = np.repeat([1, 0, 0] if joined_to_largest else [0, 1, 0], [SMALL, LARGE, NEW])
    solved = _result(loop_walk(NUM + NEW), components)
    monkeypatch.setattr(growing.camera, "measure_camera", lambda state: state)
    monkeypatch.setattr(growing.camera, "keep_lenses", lambda *_: None)
    monkeypatch.setattr(growing.backend, "reconstruct", lambda _, amended: amended(solved))
    monkeypatch.setattr(growing.finished_run, "keep", lambda _: None)
    monkeypatch.setattr(growing.outputs, "write", lambda _, result, __: result)
    result = cast(Any, growing._write(_joined(components), _maps(), None, None))
    assert (result.vertical is UP, result.origin is ORIGIN) == (joined_to_largest,) * 2
    assert (result.vertical is None, result.origin is None) == (not joined_to_largest,) * 2


def test_only_maps_that_keep_their_world_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map that the recording joins to the largest one has moved there."""
    maps, state, held = _maps(), _joined(np.zeros(NUM + NEW, int)), list[np.ndarray]()
    monkeypatch.setattr(growing, "held_runs", lambda _: nullcontext())
    monkeypatch.setattr(growing.FinishedRun, "load", lambda _: maps.runs[0])
    monkeypatch.setattr(growing, "_store_beside", lambda *_: nullcontext(run_folder))
    monkeypatch.setattr(growing, "refine_each", lambda *_, **__: None)
    monkeypatch.setattr(growing, "_joined", lambda *_: (state, maps))
    monkeypatch.setattr(growing.map_joining, "hold", lambda state, rows: held.append(rows) or state)
    monkeypatch.setattr(growing.map_joining, "tie", lambda state, _: state)
    monkeypatch.setattr(growing, "_finish", lambda *_, held: held)
    run_folder = SimpleNamespace(root=Path("run"))
    kept = growing.add_recordings("run", [Recording("new")], fixed=True)
    assert cast(Any, kept).tolist() == held[0].tolist() == list(range(SMALL, NUM))


def test_what_is_known_of_a_map_leaves_with_it() -> None:
    """And a recording none of whose frames shows a point is a map of its own."""
    world, sizes = make_world(0, num_frames=12, num_points=300), {"a": 6, "b": 4, "z": 2}
    shown = world.tracks.frames < 10
    tracks, points = world.tracks.of_observations(shown), np.unique(world.tracks.points[shown])
    landmarks = Landmarks(world.points_world[points], tracks, Counts(0, 0, "tracks"))
    solution = Solution(world.world_T_rigs, landmarks, 1.0, ())
    result = _result(world.world_T_rigs, np.repeat([0, 1], [6, 6]))
    result = replace(result, vertical=UP, origin=ORIGIN)
    run = _run(_frames(sizes), result, Map(solution, world.keypoints, np.ones(12)))
    left = run.without(["a"]).result
    assert left.components is not None and left.components.tolist() == [0, 0, 0, 0, 1, 1]
    assert left.vertical is None and left.origin is None
    left = run.without(["z"]).result
    assert left.vertical is UP and left.origin is ORIGIN


@pytest.mark.parametrize("followed", [True, False])  # whether the first recording has a trajectory
@pytest.mark.parametrize("apart", [True, False])
def test_the_origin_is_that_of_the_recording_whose_world_the_largest_map_has(
    followed: bool, apart: bool
) -> None:
    poses, sizes = loop_walk(SMALL + LARGE), (SMALL, LARGE)
    sources = [PoseSource.SLAM if followed else PoseSource.NONE, PoseSource.SLAM]
    origins = [np.array([1e6, 0.0, 0.0]) if followed else None, ORIGIN]
    parts = np.split(poses, [SMALL])
    each = [
        CoarsePoses(part, np.full(num, source, np.uint8), 0.0, origin=origin)
        for part, num, source, origin in zip(parts, sizes, sources, origins, strict=True)
    ]
    prior = Prior.of(replace(joined_poses(each), segments=None))
    maps = np.repeat([1, 0], sizes) if apart else None
    prior = replace(prior, parts=maps, of_recordings=tuple(map(Prior.of, each)))
    assert prior.worlds().origin is (origins[0] if followed and not apart else ORIGIN)


@pytest.mark.parametrize("place", [Path("."), Path("stages/..")])
def test_a_run_grows_where_it_is_the_current_folder(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run" / "stages").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "run")
    assert growing._place_of(place, None) == tmp_path / "run"
    found = run_gsba("localize", tmp_path / "other", place)  # pictures of this folder
    fails(found, "is not a gsba run")


def test_a_readout_is_not_made_of_motion_from_one_recording_to_another(tmp_path: Path) -> None:
    """Of a run that did not find it, whose recordings' clocks show the same times."""
    poses, still, shown = loop_walk(24), Lenses(np.array([0.0, 0, 0.01])), dict[str, FrameSet]()
    for name, num in {"a": 12, "b": 6, "c": 6}.items():
        paths = [(tmp_path / f"{name}{f}.jpg",) for f in range(num)]
        for (path,) in paths:
            path.write_text(path.name)
        shown[name] = frames_of(PictureFormat("erp", 512, 256), paths)
    rolling = replace(still, row_directions=np.eye(3)[:2], readout_motion=np.zeros((12, 6)))
    runs = list[Any]()
    for lenses in (rolling, still):
        given = lenses.centre, np.eye(3), np.zeros(0), "", Counts(0, 0, "observations")
        camera = FoundCamera(LensCentres(lenses, *given), readout=CameraEstimate(lenses, 0.02))
        known = {"map": SimpleNamespace(cameras=(camera,)), "frames": range(12)}
        runs.append(SimpleNamespace(result=SimpleNamespace(components=None), **known))
    frames = combine(shown)
    joint = JointCameras(frames.formats, (CameraSettings(),), ((0,), (0,)), (0,))
    (found,) = joint.found(runs, (Sim3(), Sim3()), Solution.without_points(poses), frames)
    motion = found.lenses.readout_motion
    assert motion is not None and not motion[:12].any()
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).mean()
    assert np.allclose(np.linalg.norm(motion[12:, 3:], axis=1), 0.02 * step, rtol=0.1)


def test_pictures_that_changed_since_a_call_was_interrupted_are_taken_again(tmp_path: Path) -> None:
    """Extracted anew from the run's video, under the names that they had."""
    frames, first = _frames({"walk": 2}), tmp_path / "first"
    (first / "frames").mkdir(parents=True)
    paths = [(first / "frames" / f"{f}.jpg",) for f in range(2)]
    frames = replace(frames, paths=tuple(paths))
    for content in ("before", "after"):
        for (path,) in paths:
            path.unlink(missing_ok=True)
            path.write_text(content)
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            store.stage("frames", [content], lambda: frames, FrameSet)
            (kept,) = growing.complete(store, frames, [first, store.root], store.root).paths[1]
        assert kept.read_text() == content and tmp_path / "run" in kept.parents
