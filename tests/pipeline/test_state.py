"""Matches that the state of a run hands on, and features that it leaves."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsba.config import CameraSettings, RefineSettings
from gsba.pipeline.prior import Prior
from gsba.pipeline.refine import _add_keypoints_where_weak
from gsba.pipeline.run import Evidence, RecordingEvidence, Run
from gsba.pipeline.state import MapMatches, State
from gsba.store.store import RunStore
from gsba.types import CoarsePoses, FrameSet, Matches, PictureFormat, VerifiedPairs


def _matches(*pairs: tuple[int, int]) -> Matches:
    rows = [np.zeros((1, 2), np.int32)] * len(pairs)
    return Matches.of_rows(np.array(pairs, np.int32).reshape(-1, 2), rows)


def test_sets_are_in_the_order_in_which_tracks_are_built() -> None:
    near, known, across, loops = (_matches((0, n)) for n in range(1, 5))
    assert MapMatches(near).sets() == [near]
    assert MapMatches(near, loops=loops, known_points=known).sets() == [near, known, loops]
    assert MapMatches(near, known, across, loops).sets() == [near, known, across, loops]


def test_matches_between_parts_are_dropped_where_parts_were_found_apart() -> None:
    parts, loops = np.array([0, 0, 1, 1]), _matches((0, 3))
    found = MapMatches(_matches((0, 1), (1, 2), (2, 3)), _matches((0, 2)), loops=loops)
    within = found.within(parts)
    assert within.neighbours.pairs.tolist() == [[0, 1], [2, 3]]
    assert within.known_points is not None and len(within.known_points.pairs) == 0
    assert within.across is None and within.loops is loops
    assert MapMatches(found.neighbours).within(parts).known_points is None


@pytest.mark.parametrize("prefix", ["", "first-"])
def test_features_of_weak_frames_go_where_no_frame_is_weak(prefix: str, tmp_path: Path) -> None:
    """Those of an earlier call, or of lenses before these were calibrated, would be read for the
    frames' own when pictures are localised."""
    stages = [tmp_path / "run" / "stages" / f"{name}features_closer" for name in ("", "first-")]
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        for stage in stages:
            stage.mkdir(parents=True)
            (stage / "0.npz").touch()
        store._prefix = prefix
        run = SimpleNamespace(store=store, settings=RefineSettings())
        prior = SimpleNamespace(weak_frames=lambda: np.zeros(3, bool))
        state: Any = SimpleNamespace(run=run, prior=prior, observed=SimpleNamespace(more=False))
        assert _add_keypoints_where_weak(state) is state
    assert [stage.exists() for stage in stages] == [prefix != "", prefix == ""]


@pytest.mark.parametrize("of_b", [False, True])
def test_frames_without_times_have_no_published_readout(of_b: bool, tmp_path: Path) -> None:
    """Each of several cameras by its own frames: numbers of frames are no seconds."""
    picture = tmp_path / "0.png"
    picture.touch()
    frames = FrameSet(
        tuple(f"{'ab'[n > 1]}/{n}" for n in range(4)),
        ((picture,),) * 4,
        np.arange(4.0),
        (None,) * 4,
        (PictureFormat("erp", 64, 32),) * 2,
        (0, 0, 1, 1),
        clock_shifts=(0.0,) * 4,
    ).with_timed((False, False, of_b, of_b))
    start = CoarsePoses(np.tile(np.eye(4), (4, 1, 1)), np.zeros(4, np.uint8), 0.0)
    given = zip("ab", ("insta360-x5", "dji-osmo-360"), strict=True)
    recordings = tuple(
        RecordingEvidence(name, start.taken(np.arange(2)), camera=CameraSettings(name=model))
        for name, model in given
    )
    settings, evidence = RefineSettings(), Evidence(recordings=recordings)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        run = Run.begin(store, frames, start, settings, evidence)
        nothing: Any = None
        none = VerifiedPairs.none()
        state = State(run, Prior.of(start), nothing, nothing, none, MapMatches(none.matches))
        context = state.context_of_images(settings.priors)
    cameras = [context.of_camera(number).settings.camera for number in range(2)]
    assert [one.readout() is not None for one in cameras] == [False, of_b]
    assert [(one.baseline() or (0.0,))[0] for one in cameras] == [0.032, 0.025]
