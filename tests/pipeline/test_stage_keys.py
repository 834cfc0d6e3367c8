"""A stage that reads a setting has it in its key, or rests on one that has: none is resumed under
settings it was not computed with."""

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from plain_records import frames_of
from pydantic import BaseModel
from synthetic import loop_walk
from tiny_run import LIGHT, Case
from two_fisheyes import made_pair, write

from gsba import refine
from gsba.camera.cameras import Cameras
from gsba.config import CameraSettings, ExportSettings, RefineSettings
from gsba.config_file import load_config
from gsba.features import SiftExtractor, extraction
from gsba.frames.cubemap import rig_for
from gsba.frames.recordings import combine
from gsba.masks.segmentation import segmented
from gsba.pipeline import backend, camera, outputs
from gsba.pipeline.run import Run
from gsba.placement.placement import Placement
from gsba.store import store
from gsba.store.store import RunStore, load_stage
from gsba.types import CoarsePoses, FrameSet, PictureFormat

CHANGES = (*LIGHT, "seed=7919", "weak_frames.mode=auto", "export.formats=[]")
# Results do not depend on threads. Keys have the readout and the stitching radius of a camera
# instead of its name, and directions of its lenses where they are given.
NOT_IN_KEYS = {"num_threads", "name", "baseline_mm", "readout_ms", "lens_yaws_deg"}
UNNAMED = {"seed", "extractor", "matcher", "gate_factor"}  # whose values alone are in keys


@pytest.mark.parametrize("with_trajectory", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_keys_of_stages_hold_the_settings_that_these_read(
    case: Case, with_trajectory: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys, computing = dict[str, str](), list[str]()
    read = defaultdict[str, set[tuple[str, str]]](set)
    key, measuring, get = RunStore._key, store._measuring, BaseModel.__getattribute__

    def keyed(self: RunStore, name: str, settings: object, after: Sequence[str]) -> str:
        own = json.dumps(settings, default=store._jsonable)
        keys[self._prefix + name] = own + "".join(keys[self._prefix + stage] for stage in after)
        return key(self, name, settings, after)

    def measured(name: str, *given: Any) -> Callable[[], store.StageRecord]:
        computing.append(name)
        record = measuring(name, *given)
        return lambda: (computing.remove(name), record())[1]

    def got(self: BaseModel, name: str) -> object:
        value = get(self, name)
        if computing and name in type(self).model_fields and not isinstance(value, BaseModel):
            read[computing[-1]].add((name, json.dumps(value)))
        return value

    monkeypatch.setattr(RunStore, "_key", keyed)
    monkeypatch.setattr(store, "_measuring", measured)
    monkeypatch.setattr(BaseModel, "__getattribute__", got)
    trajectory = case.slam if with_trajectory else None
    refine(case.frames, trajectory, tmp_path / "run", load_config(None, CHANGES))
    monkeypatch.undo()

    missing = {
        (stage, name)
        for stage, found in read.items()
        for name, value in found
        if name not in NOT_IN_KEYS
        and (value if name in UNNAMED else f'"{name}": ') not in keys[stage]
    }
    assert not missing and sum(map(len, read.values())) > 30


@pytest.mark.parametrize(("clock_s", "origin"), [(1000.0, [0.0, 0, 0]), (0.0, [5e5, 0, 0])])
def test_clocks_of_recordings_and_the_origin_of_the_world_are_in_keys(
    clock_s: float, origin: list[float], tmp_path: Path
) -> None:
    """Though the times of recordings laid end to end, and poses near the origin, stay the same."""
    (tmp_path / "0.jpg").touch()
    kind, paths = PictureFormat("erp", 512, 256), [(tmp_path / "0.jpg",)]
    frames = combine({"walk": frames_of(kind, paths * 4)})
    moved = frames_of(kind, paths * 4, times=clock_s + np.arange(4.0))
    poses, sources = loop_walk(4), np.zeros(4, np.uint8)
    given = [
        (frames, CoarsePoses(poses, sources, 0.0, origin=np.zeros(3))),
        (combine({"walk": moved}), CoarsePoses(poses, sources, 0.0, origin=np.array(origin))),
    ]
    for known, coarse in given:
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as run:
            Run.begin(run, known, coarse, RefineSettings())
            assert not run.records["frames"].resumed
    assert load_stage(tmp_path / "run", "frames", FrameSet).clock_shifts == (-clock_s,) * 4


def test_whose_a_mask_is_and_what_recordings_are_called_are_in_keys(tmp_path: Path) -> None:
    """Though files, numbers of frames and times stay the same."""
    for name in ("a0.jpg", "b0.jpg", "stick.png"):
        (tmp_path / name).write_text(name)
    kind, stick = PictureFormat("erp", 512, 256), tmp_path / "stick.png"

    def both(*masks: Path | None, names: tuple[str, str] = ("a", "b")) -> FrameSet:
        files = [[(tmp_path / f"{letter}0.jpg",)] * 4 for letter in "ab"]
        parts = zip(names, files, masks, strict=True)
        return combine({name: frames_of(kind, own, mask=mask) for name, own, mask in parts})

    coarse = CoarsePoses(np.tile(loop_walk(4), (2, 1, 1)), np.zeros(8, np.uint8), 0.0)
    for frames in (both(stick, None), both(None, stick), both(None, stick, names=("a", "attic"))):
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as run:
            Run.begin(run, frames, coarse, RefineSettings())
        kept = load_stage(tmp_path / "run", "frames", FrameSet)
        assert kept.mask_paths == frames.mask_paths and kept.names == frames.names


@pytest.mark.parametrize("stage", ["features", "segmented"])
def test_a_recording_under_the_calibration_of_another_one_is_cut_anew(
    stage: str, tmp_path: Path
) -> None:
    """Though the calibrations of all cameras stay the same."""
    pair = made_pair(64)
    other = replace(pair[0], focal=1.2 * pair[0].focal), pair[1]
    rng, settings, folder = np.random.default_rng(0), RefineSettings(), tmp_path / "run"
    files = {
        name: tuple(
            write(tmp_path / f"{name}{n}.png", rng.integers(40, 250, (64, 64, 3), np.uint8))
            for n in range(2)
        )
        for name in "abc"
    }
    for last in (pair, other):
        lenses = {"a": pair, "b": other, "c": last}
        frames = combine(
            {
                name: frames_of(PictureFormat("fisheye", 128, 64, fisheyes=one), [files[name]] * 2)
                for name, one in lenses.items()
            }
        )
        assert [kind.fisheyes for kind in frames.formats] == [pair, other]
        with RunStore(folder, {"frames": tmp_path}) as run:
            if stage == "segmented":
                segmented(run, frames, "cp {image} {mask}")
            else:
                rig = rig_for(frames.formats[0], settings.cubemap)
                make = partial(SiftExtractor, settings.features)
                extraction.extract(run, extraction.Search(frames, rig, settings, make), [])
            assert not run.records[stage].resumed


def test_baselines_are_in_keys_of_results_that_depend_on_them() -> None:
    """Lens centres depend on whether a baseline is published; the result of several cameras
    depends on its length."""

    def keys(*millimetres: float | None) -> str:
        cameras = tuple(CameraSettings(baseline_mm=one) for one in millimetres)
        several, kept = cameras if len(cameras) > 1 else (), list[object]()
        run = SimpleNamespace(
            frames=SimpleNamespace(formats=cameras),
            settings=RefineSettings(),
            camera_settings=several,
            settings_of=cameras.__getitem__,
            solving_key=list,
            stage=lambda name, key, *_: kept.append(key),
        )
        nothing, prior = SimpleNamespace(), SimpleNamespace(turning_only=False)
        state: Any = SimpleNamespace(run=run, prior=prior, map=nothing, solution=nothing)
        backend.reconstruct(state)
        return store.digest(camera._settings_of_cameras(state.run), kept)

    assert keys(None) != keys(32.0) == keys(30.0)
    assert keys(32.0, 28.0) != keys(32.0, 30.0)


def test_every_kind_of_exported_images_has_a_key_of_its_own(tmp_path: Path) -> None:
    """Metashape gets panoramas by default, and faces on request."""
    frames = frames_of(PictureFormat("erp", 512, 256), [(tmp_path / "0.jpg",)])

    def key(**settings: Any) -> object:
        kept = list[object]()
        folder = SimpleNamespace(
            root=tmp_path,
            forget=lambda _: None,
            stored=lambda *given: kept.append(given[1]),
            stage=lambda *_: None,
            claim=lambda _: None,
        )
        export = ExportSettings(formats=("metashape",), **settings)
        chosen = RefineSettings(export=export)
        run: Any = SimpleNamespace(store=folder, settings=chosen, latest=[])
        outputs._export(run, cast(Any, None), frames, Placement(), Cameras.plain(frames))
        return kept

    given: list[dict[str, Any]] = [{}, {"images": "cube"}, {"fetched": True}, {"face_size": 64}]
    keys = [store.digest(key(**settings)) for settings in given]
    assert len({*keys}) == len(given) and keys[0] == store.digest(key())
