"""The time that a run still takes, by synthetic events of runs."""

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest

from gsba.odometry.tour_maps import STEPS_SEARCH
from gsba.pipeline import stage_titles
from gsba.report import time_left
from gsba.report.time_left import (
    CAMERA,
    FEATURES,
    FIRST_PATCHES,
    LAST_PATCHES,
    OPTIONAL,
    PHASES,
    WEAK,
    Size,
    TimeLeft,
    phase_of,
)

RUN = {"event": "run", "frames": 100, "width": 2000, "trajectory": True, "video": False}
RUN |= {"raw": False, "uncut": False, "camera": "central", "rounds": 4, "threads": 2}
STAGES = ("carrier", "features", "neighbours", "chain", "loops", "axes", "features_closer")
STAGES += ("everywhere1", "align1", "align2", "align3", "align4", "reconstruction")
CENTRAL = Size.of(RUN)


def told(*entries: dict[str, Any], **size: Any) -> TimeLeft:
    """The time left after the size of a run, and these events."""
    found = TimeLeft()
    for entry in ({**RUN, **size, "time": 0.0}, *entries):
        found.add(entry)
    return found


def stages(names: Sequence[str], speed: float = 1.0, size: Size = CENTRAL) -> list[dict[str, Any]]:
    """Events of stages that take as long as the table says, times `speed`."""
    found, now = [], 0.0
    for name in names:
        phase = phase_of(name)
        assert phase is not None
        found.append({"event": "stage", "name": name, "time": now})
        now += speed * size.seconds(phase)
        found.append({"event": "done", "name": name, "time": now, "resumed": False})
    return found


def whole(size: Size) -> float:
    return sum(map(size.seconds, range(len(PHASES))))


def left(found: TimeLeft, now: float) -> float:
    """The most that is stated: all phases of `STAGES` come."""
    return both(found, now)[1]


def both(found: TimeLeft, now: float) -> tuple[float, float]:
    seconds = found.seconds(now)
    assert seconds is not None and seconds[0] <= seconds[1]
    return seconds


def names() -> Iterator[str]:
    """A name for each stage that has a title."""
    for pattern in stage_titles._TITLES:
        yield re.sub("[#+]", "1", pattern)


def test_every_stage_has_a_phase() -> None:
    without = {name for name in names() if phase_of(name) is None}
    assert without == {"odometry", "photometric", "splat", "tour"}
    assert [phase_of(name) for name in STAGES] == list(range(len(PHASES)))
    assert phase_of("lenses0") == phase_of("settled_far_readout") == CAMERA
    assert phase_of("settled_aligned3") == phase_of("align2") == LAST_PATCHES - 2
    assert (
        phase_of("align4")
        == phase_of("settled_aligned8")
        == phase_of("aligned12_1")
        == LAST_PATCHES
    )
    assert phase_of("features@walk") == FEATURES and phase_of("again_lensed0") == CAMERA + 2
    assert phase_of("first-features") is None  # of a first solution, which the table leaves out


def test_a_run_as_the_table_says_takes_what_it_says() -> None:
    events = stages(STAGES)
    assert left(told(), 0.0) == pytest.approx(whole(CENTRAL))
    for number, entry in enumerate(events):
        now = entry["time"]
        found = told(*events[: number + 1])
        assert left(found, now) == pytest.approx(whole(CENTRAL) - now, abs=1e-6)


def test_phases_tell_the_speed() -> None:
    events = stages(STAGES, speed=3.0)
    found, now = told(*events[:11]), events[10]["time"]
    rest = sum(CENTRAL.seconds(n) for n in range(5, len(PHASES)))
    assert 2.0 * rest < left(found, now) < 3.0 * rest
    # items of features tell it before their phase ends
    begin, half = events[2]["time"], 1.5 * CENTRAL.seconds(FEATURES)
    counts = [
        {"event": "progress", "what": "features", "done": n, "total": 100, "time": begin + t}
        for n, t in ((0, 0.0), (50, half))
    ]
    later = sum(CENTRAL.seconds(n) for n in range(2, len(PHASES)))
    stated = left(told(*events[:3], *counts), begin + half)
    assert later + half < stated < 3.0 * later + half
    assert stated > left(told(*events[:3]), begin + half)


def test_a_search_along_epipolar_lines_is_timed_by_its_steps_and_is_no_measure_of_others() -> None:
    events = stages(STAGES)
    now = events[5]["time"]  # the end of neighbours
    begin = {"event": "stage", "name": "tour", "time": now}
    assert told(*events[:5], begin).seconds(now) is None
    counts = [
        {"event": "progress", "what": "steps", "done": n, "total": 20, "time": now + 10.0 * n}
        for n in (0, 5)
    ]
    rest = sum(CENTRAL.seconds(n) for n in range(3, len(PHASES)))
    assert left(told(*events[:5], begin, *counts), now + 50.0) == pytest.approx(150.0 + rest)
    # Maps are joined after the steps.
    steps = [{**entry, "what": STEPS_SEARCH} for entry in counts]
    found = told(*events[:5], begin, *steps).seconds(now + 50.0)
    assert found is not None
    assert found[0] < 190.0 + rest + 1.0 and found[1] > 269.0 + rest
    joins = [
        {"event": "progress", "what": "joining maps", "done": n, "total": 4, "time": now + t}
        for n, t in ((0, 200.0), (1, 220.0))
    ]
    searched = {**steps[0], "done": 20, "time": now + 200.0}
    found = told(*events[:5], begin, *steps, searched, *joins).seconds(now + 220.0)
    assert found is not None
    assert found[0] < 61.0 + rest and found[1] == pytest.approx(100.0 + rest)
    # A few joins at once are not all of them.
    tried = {**joins[1], "done": 4, "time": now + 250.0}
    found = told(*events[:5], begin, *steps, searched, joins[0], tried).seconds(now + 250.0)
    assert found is not None
    assert found[0] < rest + 0.1 and found[1] == pytest.approx(70.0 + rest)
    ended = {"event": "done", "name": "tour", "time": now + 200.0, "resumed": False}
    chain = {"event": "stage", "name": "chain", "time": now + 200.0}
    found = told(*events[:5], begin, *counts, ended, chain)
    assert left(found, now + 200.0) == pytest.approx(rest)


def test_resumed_phases_are_no_measure() -> None:
    events = [{**entry, "resumed": True} for entry in stages(STAGES) if entry["event"] == "done"]
    found = told(*({**entry, "time": 1.0} for entry in events[:8]))
    rest = sum(CENTRAL.seconds(n) for n in range(8, len(PHASES)))
    assert left(found, 1.0) == pytest.approx(rest + CENTRAL.seconds(7))


def test_features_of_some_frames_are_no_measure_of_all() -> None:
    events = stages(STAGES)[:6]
    begin, ended = events[2]["time"], events[3]["time"]
    some = [
        {"event": "progress", "what": "features", "done": n, "total": 10, "time": begin + 0.1 * t}
        for n, t in ((0, 0.0), (10, ended - begin))
    ]
    later = [{**entry, "time": entry["time"] - 0.9 * (ended - begin)} for entry in events[3:]]
    stated = left(told(*events[:3], *some, *later), later[-1]["time"])
    assert stated == pytest.approx(left(told(*events), events[-1]["time"]))


def test_what_is_known_of_the_run_counts() -> None:
    start = left(told(), 0.0)
    assert left(told(frames=200), 0.0) > 1.5 * start
    assert left(told(width=4000), 0.0) > start
    assert left(told(trajectory=False), 0.0) > start
    assert left(told(rounds=0), 0.0) < 0.8 * start
    assert 0.1 * start < left(told(threads=16), 0.0) < 0.7 * start
    assert start < left(told(camera="auto"), 0.0) == left(told(camera="two_lens"), 0.0)
    assert left(told(raw=True), 0.0) > start
    assert left(told(raw=True, uncut=True), 0.0) > 2 * left(told(raw=True), 0.0)


def test_the_least_is_without_what_may_not_come() -> None:
    start = both(told(), 0.0)
    optional = sum(CENTRAL.seconds(n) for n in OPTIONAL)
    assert start[1] - start[0] == pytest.approx(optional) and optional > 0
    assert both(told(camera="auto"), 0.0)[0] == start[0]
    two = both(told(camera="two_lens"), 0.0)
    assert two[0] > start[0]
    # the last phase is certain, and a phase that has begun is not optional
    events = stages(STAGES)
    least, most = both(told(*events[:-1]), events[-2]["time"])
    assert least == most
    weak = stages(STAGES)[2 * WEAK]
    least, _ = both(told(*events[: 2 * WEAK + 1]), weak["time"])
    certain = [n for n in range(WEAK, len(PHASES)) if n == WEAK or n not in OPTIONAL]
    assert least == pytest.approx(sum(map(CENTRAL.seconds, certain)))


def test_no_frames_are_weak_where_all_have_more_keypoints() -> None:
    events = stages(STAGES)
    now = events[10]["time"]
    usual, more = (left(told({"event": "features", "more": m}, *events[:11]), now) for m in (0, 1))
    assert more < usual


def test_two_lenses_count_as_soon_as_they_are_found() -> None:
    events = stages(STAGES)
    now = events[12]["time"]
    unknown = left(told(*events[:11], camera="auto"), now)
    lensed = {"event": "stage", "name": "lensed0", "time": now}
    none = left(told(*events[:13], camera="auto"), now)
    found = left(told(*events[:11], lensed, *events[11:13], camera="auto"), now)
    assert none < found <= unknown and found > 1.5 * none


def test_patches_take_as_long_as_the_map_has_observations() -> None:
    events = stages(STAGES)
    found = []
    for observations in (20000, 40000):
        now = events[15]["time"]
        map_ = {"event": "map", "name": "refined1", "observations": observations, "time": now}
        found.append(left(told(*events[:16], map_, width=500), now))
    assert 1.1 * found[0] < found[1] < 2.0 * found[0]


def test_rounds_of_patches_tell_the_time_of_the_next_ones() -> None:
    usual, slow = (stages(STAGES, speed=1.0) for _ in range(2))
    second = STAGES.index("align2")
    for entry in slow[2 * second :]:  # the first round has taken twice as long
        entry["time"] += CENTRAL.seconds(FIRST_PATCHES)
    now = usual[2 * second]["time"]
    stated, other = (
        left(told(*events[: 2 * second + 1]), events[2 * second]["time"])
        for events in (usual, slow)
    )
    rounds = sum(CENTRAL.seconds(n) for n in range(second, LAST_PATCHES + 1))
    assert stated == pytest.approx(whole(CENTRAL) - now)
    assert stated + 0.5 * rounds < other < 2.0 * stated


def test_a_second_pass_of_raw_frames() -> None:
    raw = replace(CENTRAL, raw=True, lenses=1.0)
    first = stages(STAGES[:-1], size=replace(raw, uncut=True))
    now = first[-1]["time"]
    again = {"event": "stage", "name": "recut0", "time": now}
    stated = left(told(*first, again, raw=True, uncut=True), now)
    assert whole(raw) < stated < 2 * whole(raw)


def test_odometry_tells_how_many_frames_come() -> None:
    size = {"frames": 0, "trajectory": False, "video": True}
    stage = {"event": "stage", "name": "odometry", "time": 0.0}
    count = {"event": "progress", "what": "tracking", "total": 400, "time": 0.0, "done": 0}
    assert told(stage, count, **size).seconds(0.0) is None
    keyframes = [{"event": "keyframe", "time": 5.0}] * 20
    half = {**count, "time": 10.0, "done": 100}
    stated = left(told(stage, count, *keyframes, half, **size), 10.0)
    assert stated > 30.0  # of the odometry alone
    more = left(told(stage, count, *keyframes, *keyframes, half, **size), 10.0)
    assert more > stated
    ended = {"event": "done", "name": "odometry", "time": 40.0}
    whole_walk = {**half, "time": 40.0, "done": 400}
    extracting = {**count, "what": "extracting frames", "total": 80, "time": 41.0, "done": 1}
    before = left(told(stage, count, *keyframes, whole_walk, **size), 40.0)
    after = left(told(stage, count, *keyframes, whole_walk, ended, extracting, **size), 41.0)
    assert 0.0 < after < before  # by the loops that were closed
    places = {**count, "what": "describing places", "total": 80, "time": 40.0, "done": 1}
    assert told(stage, *keyframes, places, **size).seconds(40.0) is None


def test_what_the_table_does_not_know_has_no_time() -> None:
    assert TimeLeft().seconds(0.0) is None
    assert told(camera="of a later version").seconds(0.0) is None
    assert told({"event": "stage", "name": "similarities_of_two_maps"}).seconds(0.0) is None
    assert told({"event": "start"}).seconds(0.0) is None  # a job goes on: all is told again


def test_lines_of_the_log(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [1000.0]
    monkeypatch.setattr(time_left.time, "time", lambda: clock[0])
    found = time_left.LoggedTimeLeft()
    with caplog.at_level(logging.INFO, "gsba"):
        found.add({**RUN, "frames": 10000, "time": 1000.0})
        assert not caplog.messages and found.note().endswith("left of the run")
        for clock[0] in (1005.0, 1021.0, 1030.0, 1045.0):
            found.add({"event": "stage", "name": "features", "time": 1005.0})
    assert len(caplog.messages) == 2 and all("left" in line for line in caplog.messages)


def test_durations_in_words() -> None:
    words = [time_left.duration(seconds) for seconds in (12.3, 89, 150, 3 * 3600)]
    assert words == ["12 s", "89 s", "2 min", "3.0 h"]


def test_a_range_is_one_duration_where_its_mean_is_a_third_off_at_most() -> None:
    ranges = [(9.0, 16.0), (9.0, 16.1), (120.0, 600.0), (60.0, 600.0), (0.0, 4.0)]
    words = [time_left.in_words(one) for one in ranges]
    assert words == ["about 12 s", "9 to 16 s", "2 to 10 min", "60 s to 10 min", "0 to 4 s"]
