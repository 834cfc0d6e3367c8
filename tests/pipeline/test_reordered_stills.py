"""Stills whose names may be in no order, and what numbers frames in the order found."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from refusals import refused
from walk_on_earth import geodetic_of

from gsba.bundle.gps_factors import GpsFactors
from gsba.config import RefineSettings
from gsba.masks import merging
from gsba.matching import recovery
from gsba.matching.recovery import Recovered
from gsba.odometry.tour_maps import KeptSteps, TourMatches
from gsba.odometry.tour_steps import Step
from gsba.pipeline import frontend, tour
from gsba.pipeline.prior import Prior
from gsba.pipeline.refine import Start, _begin, _without_distractors
from gsba.pipeline.run import Evidence, Journal, Run
from gsba.pipeline.state import State
from gsba.store.store import RunStore
from gsba.trajectory.association import without_trajectory
from gsba.trajectory.judgement import StepChecks
from gsba.types import Counts, FrameSet, Matches, PictureFormat, VerifiedPairs

NAMES, FOUND = ("a", "b", "c", "d", "e"), np.array([3, 0, 4, 1, 2])


def stills_named(folder: Path, names: Sequence[str]) -> FrameSet:
    paths = tuple((folder / f"{name}.png",) for name in names)
    for (path,) in paths:
        cv2.imwrite(str(path), np.zeros((32, 64), np.uint8))
    num, kind = len(names), PictureFormat("erp", 64, 32, ())
    return FrameSet(tuple(names), paths, np.arange(num * 1.0), (None,) * num, (kind,), timed=False)


@pytest.fixture
def stills(tmp_path: Path) -> FrameSet:
    return stills_named(tmp_path, NAMES)


@pytest.fixture
def _order_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def known(store: RunStore, frames: FrameSet, settings: RefineSettings) -> FrameSet:
        return replace(frames.taken(FOUND), timestamps=np.arange(5.0))

    monkeypatch.setattr(tour, "in_known_order", known)


@pytest.mark.usefixtures("_order_is_known")
def test_fixes_by_name_stay_with_their_stills(stills: FrameSet, tmp_path: Path) -> None:
    metres = np.random.default_rng(0).normal(0, 30, (5, 3))
    rows = [
        f"{name},{latitude:.9f},{longitude:.9f},{altitude:.4f}"
        for name, (latitude, longitude, altitude) in zip(NAMES, geodetic_of(metres), strict=True)
    ]
    table = tmp_path / "gps.csv"
    table.write_text("\n".join(["name,latitude,longitude,altitude", *rows]))
    tree = {"factors": ("bearing", "gps"), "gps": {"file": str(table)}}
    settings = RefineSettings.model_validate(tree)
    start = Start.of(stills, Evidence(), settings)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        run = _begin(store, settings, merging.choose(merging.NONE), start)
    assert run.frames.names == tuple(NAMES[f] for f in FOUND)
    (before,), (after,) = start.evidence.families, run.evidence.families
    assert isinstance(before, GpsFactors) and isinstance(after, GpsFactors)
    np.testing.assert_allclose(after.fixes.positions, before.fixes.positions[FOUND])


@pytest.mark.usefixtures("_order_is_known")
def test_masks_of_a_first_solution_are_of_stills_in_the_order_given(
    stills: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that the search that follows judges the order given, not one that was found before."""

    def after(
        store: RunStore, frames: FrameSet, choice: object, solved: object, stage: str
    ) -> tuple[FrameSet, Counts]:
        masks = tuple(tmp_path / f"{name}_mask.png" for name in frames.names)
        return replace(frames, mask_paths=masks), Counts(5, 5, "frames")

    monkeypatch.setattr(merging, "after", after)
    monkeypatch.setattr(frontend, "extract", lambda run: run)
    monkeypatch.setitem(_without_distractors.__globals__, "solve", lambda run: solved)
    solved = SimpleNamespace(prior=SimpleNamespace(turning_only=False), solution=None)
    start = Start.of(stills, Evidence(), RefineSettings())
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        chosen = merging.choose(merging.DISTRACTORS)
        masked = _without_distractors(store, RefineSettings(), chosen, start, Journal())
    assert masked.names == NAMES and masked.timestamps.tolist() == stills.timestamps.tolist()
    assert masked.mask_paths == tuple(tmp_path / f"{name}_mask.png" for name in NAMES)


def match_nothing(stills: FrameSet) -> TourMatches:
    """Stills whose steps no places confirm, in the order given."""
    num, none = len(stills), np.zeros(0)
    near = VerifiedPairs.none()
    starts, open_logs = np.zeros(num + 1, np.int64), np.full(num - 2, np.inf)
    return TourMatches(
        starts, none.reshape(0, 3), none, near, np.zeros(num - 2), open_logs, stills.names
    )


class Searching:
    """A context whose network matches nothing: frames are compared by search alone."""

    def by_search(self) -> str:
        return "search"


def neighbours_tied(
    stills: FrameSet, store: RunStore, unmatched: tuple[int, int] | None = None, nearest: int = 8
) -> tuple[State, Recovered]:
    """A state whose descriptors tie all stills by name, with or without a pair that matches not;
    neighbours by `nearest` matches, frames further apart by 8."""
    pairs = [(f, f + gap) for gap in (1, 2) for f in range(len(stills) - gap)]
    pairs = [pair for pair in pairs if pair != unmatched]
    rows = [np.zeros((nearest if g == f + 1 else 8, 2), np.int32) for f, g in pairs]
    near = SimpleNamespace(matches=Matches.of_rows(np.array(pairs), rows))
    trust, settings = StepChecks.of_all(np.tile(np.eye(4), (len(stills), 1, 1))), RefineSettings()
    run = SimpleNamespace(frames=stills, settings=settings, store=store, num_threads=1, suffix="")
    state = State(cast(Run, run), Prior.of(without_trajectory(stills)), *[cast(Any, None)] * 4)
    state = replace(state, observed=cast(Any, SimpleNamespace(context=Searching())))
    return state, cast(Recovered, SimpleNamespace(neighbours=near, trust=trust))


def matching_by(monkeypatch: pytest.MonkeyPatch, counts: np.ndarray) -> None:
    """Any two frames have (F, F) matches without a prediction."""

    def match(context: object, chosen: np.ndarray, rivals: bool) -> SimpleNamespace:
        assert context == "search"
        rows = [np.zeros((int(counts[f, g]), 2), np.int32) for f, g in chosen]
        return SimpleNamespace(matches=Matches.of_rows(chosen, rows))

    monkeypatch.setattr(recovery, "match_anywhere", match)


def in_a_hall_of_bays(monkeypatch: pytest.MonkeyPatch, way: np.ndarray) -> None:
    """Each frame is as alike to those a bay away as to its neighbours on the way (F,)."""
    gaps = np.abs(np.subtract.outer(way, way))
    alike = (2 + np.cos(2 * np.pi * gaps / 3)) * np.exp(-gaps / 8.0)

    def rows(frames: FrameSet, num_threads: int) -> list[int]:
        return [int(name) for name in frames.names]

    monkeypatch.setattr(tour, "read_stills", rows)
    monkeypatch.setattr(tour, "likeness", lambda some, _: alike[np.ix_(some, some)])
    matching_by(monkeypatch, 20 * alike)


def numbered(folder: Path, num: int) -> FrameSet:
    return stills_named(folder, [f"{n:03d}" for n in range(num)])


def way_of(num: int, shuffled: bool) -> np.ndarray:
    return np.random.default_rng(0).permutation(num) if shuffled else np.arange(num)


@pytest.mark.parametrize(
    ("shuffled", "unmatched", "nearest"),
    [
        (True, (5, 6), 8),
        (True, (5, 7), 8),
        (True, None, 8),
        (True, None, 9),
        (False, (5, 6), 8),
        (False, None, 8),
    ],
)
def test_what_is_only_alike_makes_no_map_of_stills_in_no_order(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    shuffled: bool,
    unmatched: tuple[int, int] | None,
    nearest: int,
) -> None:
    stills = numbered(tmp_path, 12)
    in_a_hall_of_bays(monkeypatch, way_of(12, shuffled))
    nothing = match_nothing(stills)
    monkeypatch.setattr(tour, "match_stills", lambda *_: nothing)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        given = neighbours_tied(stills, store, unmatched, nearest)
        if shuffled and nearest == 8:  # matches show no order
            refused("the order of the stills is not known", tour.match_places, *given)
        else:
            assert tour.match_places(*given) is None


def test_a_search_that_is_interrupted_keeps_its_finished_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_a_hall_of_bays(monkeypatch, np.arange(12))
    stills, computed = numbered(tmp_path, 12), list[tuple[str, str]]()
    nan = np.full(3, np.nan)
    step = Step(np.eye(4), nan, nan, np.tile(nan, (3, 1)), np.tile(nan, (3, 1)), 7.5, 4)

    def match(_: object, names: tuple[str, ...], __: object, ___: int, kept: KeptSteps) -> Any:
        done = len(computed)

        def compute(pair: tuple[str, str]) -> list[Step]:
            computed.append(pair)
            if not done and len(computed) == 3:
                raise KeyboardInterrupt
            return [step]

        for pair in pairwise(names[:5]):
            (found,) = kept(pair, partial(compute, pair))
            assert found.rank == 7.5 and np.array_equal(found.f1_T_f0, np.eye(4))
        return match_nothing(stills)

    monkeypatch.setattr(tour, "match_stills", match)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        given = neighbours_tied(replace(stills, timed=True, timestamps=2.0 * np.arange(12)), store)
        vars(given[0].run).update(latest=[], journal=Journal())
        near = SimpleNamespace(matches=Matches.of_rows(np.zeros((0, 2), np.int32), []))
        found = cast(Recovered, SimpleNamespace(neighbours=near, trust=given[1].trust))
        with pytest.raises(KeyboardInterrupt):
            tour.match_places(given[0], found)
        assert tour.match_places(given[0], found) is None
        assert [int(first) for first, _ in computed] == [0, 1, 2, 2, 3]
        assert not (store.root / "stages" / "tour_steps").exists()


@pytest.mark.parametrize("shuffled", [False, True])
def test_an_order_that_likeness_denies_is_doubted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shuffled: bool
) -> None:
    in_a_hall_of_bays(monkeypatch, way_of(61, shuffled))
    stills = numbered(tmp_path, 61)
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        timed = neighbours_tied(replace(stills, timed=True), store)
        assert tour.check_order(*timed).prior.order_doubted == shuffled
        given = neighbours_tied(stills, store)
        if shuffled:  # more than are put in order
            refused("rename them in the order of the way", tour.check_order, *given)
        else:
            assert not tour.check_order(*given).prior.order_doubted


@pytest.mark.parametrize("shuffled", [False, True])
def test_times_of_a_few_stills_are_doubted_where_likeness_denies_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shuffled: bool
) -> None:
    in_a_hall_of_bays(monkeypatch, way_of(9, shuffled))
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        timed = neighbours_tied(replace(numbered(tmp_path, 9), timed=True), store)
        assert tour.check_order(*timed).prior.order_doubted == shuffled


def test_frames_that_match_more_than_those_far_off_are_not_asked_for_their_likeness(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaps = np.abs(np.subtract.outer(np.arange(24), np.arange(24)))
    matching_by(monkeypatch, 100 * np.exp(-gaps / 8.0))
    monkeypatch.delattr(tour, "read_stills")
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        timed = neighbours_tied(replace(numbered(tmp_path, 24), timed=True), store)
        assert not tour.check_order(*timed).prior.order_doubted


def test_a_step_across_which_no_frame_beside_it_matches_is_named(tmp_path: Path) -> None:
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        state, found = neighbours_tied(numbered(tmp_path, 10), store)
        assert tour.check_order(state, found).prior.lone_steps == ()
        matches = found.neighbours.matches
        across = [(4, 6), (5, 7), (7, 9)]  # the last one alone leaves (6, 8) across its step
        kept = [p for p, pair in enumerate(matches.pairs.tolist()) if tuple(pair) not in across]
        near = SimpleNamespace(matches=matches.taken(kept))
        fewer = cast(Recovered, SimpleNamespace(neighbours=near, trust=found.trust))
        assert tour.check_order(state, fewer).prior.lone_steps == (("005", "006"),)


def test_a_recording_of_stills_in_no_order_is_to_be_refined_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_a_hall_of_bays(monkeypatch, way_of(12, shuffled=True))
    with RunStore(tmp_path / "run", {"frames": tmp_path}) as store:
        state, found = neighbours_tied(numbered(tmp_path, 12), store)
        # left to the search
        assert not tour.check_order(state, found).prior.order_doubted
        run = cast(Run, SimpleNamespace(**vars(state.run) | {"suffix": "@upper"}))
        refused(r"refine them alone.*gsba merge", tour.check_order, replace(state, run=run), found)
