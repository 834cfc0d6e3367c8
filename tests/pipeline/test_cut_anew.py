"""Raw pairs that are cut anew by their own calibration, pass after pass."""

import importlib
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from plain_records import frames_of
from synthetic import loop_walk
from two_fisheyes import made_pair, picture, write

from gsba.camera.fisheye import turned
from gsba.config import RefineSettings
from gsba.disk import write_image
from gsba.frames.masks import load_mask
from gsba.frames.recordings import combine
from gsba.masks import merging
from gsba.masks.carrier import PICTURE_WIDTH, Carrier, no_carrier
from gsba.pipeline.each_recording import joined_poses, naming_recording
from gsba.pipeline.run import Evidence, RecordingEvidence, Run
from gsba.store.store import RunStore, load_stage
from gsba.trajectory.conventions import QUARTER_TURNS
from gsba.trajectory.judgement import StepChecks
from gsba.trajectory.misread import TurnedAboutForwardError
from gsba.types import CoarsePoses, FrameSet, PictureFormat


def test_a_pass_that_is_kept_is_kept_in_later_calls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where frames cut anew match at fewer steps, with all that rests on its stages."""
    module = importlib.import_module("gsba.pipeline.refine")
    pair, found = made_pair(64), list[Any]()
    paths = [write(tmp_path / f"{n}.png", picture(lens)) for n, lens in enumerate(pair)]
    frames = frames_of(PictureFormat("fisheye", 128, 64, fisheyes=pair), [tuple(paths)] * 3)
    coarse = CoarsePoses(loop_walk(3), np.zeros(3, np.uint8), 0.0)
    better = (replace(pair[0], focal=1.1 * pair[0].focal), pair[1])

    def solved(run: Run) -> Any:
        unseen = np.full(2, run.frames.format.fisheyes == better)
        prior = SimpleNamespace(trust=SimpleNamespace(unseen_steps=unseen))
        features = [defaultdict(lambda: found.append(run.frames.format))] * 3
        observed = SimpleNamespace(features=features)
        return SimpleNamespace(run=run, prior=prior, map=None, observed=observed)

    monkeypatch.setattr(module.frontend, "extract", lambda run: run)
    monkeypatch.setattr(module, "solve", solved)
    monkeypatch.setattr(module.camera, "better_calibration", lambda *_: ((better, True),))
    monkeypatch.setattr(module.merging, "recut", lambda _, frames, *__: frames)
    for _ in range(2):
        with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
            run = Run.begin(store, frames, coarse, RefineSettings())
            first = store.records["frames"].key
            assert module._solve_raw(run).run.frames.format.fisheyes == pair
            assert store.records["frames"].key == first
        assert load_stage(tmp_path / "run", "frames", FrameSet).format.fisheyes == pair
    assert found == [frames.format] * 3  # its features are stored again


def test_the_carrier_of_each_recording_that_is_cut_anew_is_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its new cut; masks of a camera that keeps its cut, and of frames without one, stay."""
    seen: list[tuple[str, float]] = []

    def find(frames: FrameSet) -> Carrier:
        fisheyes = frames.format.fisheyes
        assert fisheyes is not None
        seen.append((frames.names[0], fisheyes[0].focal))
        return replace(no_carrier(frames, ""), share=0.1)

    monkeypatch.setattr(merging, "find_carrier", find)
    pair = made_pair(64)
    raw = PictureFormat("fisheye", 128, 64, fisheyes=pair)
    better = (replace(pair[0], focal=1.1 * pair[0].focal), pair[1])
    files = [write(tmp_path / f"{n}.png", picture(lens)) for n, lens in enumerate(pair)]
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        masks = [store.root / "carrier@a.png", None, store.root / "carrier@c.png"]
        for mask in filter(None, masks):
            write_image(mask, np.full((64, 128), 255, np.uint8))
        frames = replace(
            frames_of(raw, [tuple(files)] * 6),
            names=tuple(f"{name}/{f}" for name in "abc" for f in range(2)),
            mask_paths=tuple(mask for mask in masks for _ in range(2)),
            formats=(raw, raw),
            camera_of_frame=(0, 0, 0, 0, 1, 1),
            clock_shifts=(0.0, 0.0, 10.0, 10.0, 20.0, 20.0),
        )
        cut = frames.with_formats([replace(raw, fisheyes=better), raw])
        for n in (1, 2):
            cut = merging.recut(store, cut, n, [0])
            assert [path and path.name for path in cut.mask_paths[::2]] == [
                f"carrier{n}@a.png",
                None,
                "carrier@c.png",
            ]
            assert (store.root / f"carrier{n}@a.png").exists()
    assert seen == [("a/0", better[0].focal)] * 2


def test_recordings_are_cut_anew_in_the_axes_of_their_trajectories_with_their_carriers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one camera, whose sensors are mounted on their sides; panoramas beside them stay."""
    module = importlib.import_module("gsba.pipeline.refine")
    pair, quarter = made_pair(64), QUARTER_TURNS[1]
    kind, parts = PictureFormat("fisheye", 128, 64, fisheyes=pair), {}
    for name, shade in (("a", 0), ("b", 9)):
        paths = [
            write(tmp_path / f"{name}{n}.png", picture(lens) - np.uint8(shade))
            for n, lens in enumerate(pair)
        ]
        parts[name] = frames_of(kind, [tuple(paths)] * 3)
    coarse = [CoarsePoses(loop_walk(3), np.zeros(3, np.uint8), 0.0) for _ in parts]
    evidence = Evidence(
        recordings=tuple(map(RecordingEvidence, parts, coarse)),
    )
    stays = np.ones((PICTURE_WIDTH // 2, PICTURE_WIDTH), bool)
    stays[160:, :80] = False

    def find(own: FrameSet) -> Carrier:
        mask = stays if own.format.fisheyes == pair else np.roll(stays, 128, axis=1)
        return replace(no_carrier(own, ""), mask=mask, share=0.1)

    def solved(run: Run) -> Any:
        if run.frames.format.fisheyes == pair:
            with naming_recording("b"):
                raise TurnedAboutForwardError("the trajectory is in other axes", quarter)
        prior = SimpleNamespace(trust=StepChecks.of_all(loop_walk(3)))
        return SimpleNamespace(run=run, prior=prior, map=None)

    monkeypatch.setattr(merging, "find_carrier", find)
    monkeypatch.setattr(module.frontend, "extract", lambda run: run)
    monkeypatch.setattr(module, "solve", solved)
    monkeypatch.setattr(module.camera, "better_calibration", lambda *_: None)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        frames = merging.before(store, combine(parts), merging.choose("auto"))
        assert {path.name for path in frames.mask_paths} == {"carrier@a.png", "carrier@b.png"}
        start = joined_poses(coarse)
        run = Run.begin(store, frames, start, RefineSettings(), evidence)
        found = module._solve_raw(run).run.frames
    assert found.format.fisheyes == turned(pair, quarter)
    assert [path.name for path in found.mask_paths[2:4]] == ["carrier1@a.png", "carrier1@b.png"]
    assert not load_mask(found, 0)[50, 40] and load_mask(found, 0)[50, 10]
