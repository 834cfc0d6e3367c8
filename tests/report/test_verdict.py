"""The verdict: its level, its sentence and its reasons, by the figures of a map."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from walk_on_earth import walk_result

from gsba.report.verdict import (
    Figures,
    Level,
    Verdict,
    _position_error,
    _smaller_sides,
    verdict_on,
)
from gsba.types import JointErrors, PoseStatus, RunStart

NUM = 20
NAMES = tuple(f"{n:03d}" for n in range(NUM))
GOOD = Figures(
    frames=NUM,
    exported=NUM,
    points=5000,
    position_error=0.0004,
    neighbour_pixels=0.13,
    extent_metres=math.nan,
    held_steps=(),
    false_steps=0,
    unmatched_steps=0,
    unrefined=(),
    scale_changes=(math.nan, *(0.003,) * (NUM - 3), math.nan),
    moved_by_scale=(math.nan, *(0.0007,) * (NUM - 3), math.nan),
    deviations=(0.01,) * (NUM - 1),
    overlaps=(math.nan, *(0.9,) * (NUM - 3), math.nan),
)
LOOSE = {"scale_changes": (0.0, 0.0, 0.053, 0.03), "moved_by_scale": (0.0, 0.0, 0.012, 0.004)}


def _verdict(figures: Figures, names: tuple[str, ...] = NAMES, **more: Any) -> Verdict:
    report = {
        "start": RunStart.ODOMETRY,
        "frames": [{"name": name} for name in NAMES],
        "frame_lists": {"fetched": []},
        "maps": [{"reason": None}] * (1 + (len(names) < NUM)),
    }
    return verdict_on(figures, report | more, names)


def test_a_good_map_is_said_to_be_good_in_a_sentence() -> None:
    found = _verdict(GOOD)
    assert (found.level, found.reasons) == (Level.GOOD, ())
    assert found.sentence == (
        "good to train: all 20 frames are in one map; positions may be off by up to 0.04 % of "
        "the path's extent, 0.13 pixels in a neighbour's picture"
    )


@pytest.mark.parametrize(
    ("num", "timed", "pose", "level"),
    [
        (11, False, RunStart.PAIRS, Level.LOOK),
        (12, False, RunStart.PAIRS, Level.GOOD),  # whose order was looked for
        (11, True, RunStart.PAIRS, Level.GOOD),
        (11, False, RunStart.TRAJECTORY, Level.GOOD),
    ],
)
def test_few_stills_without_times_or_trajectory_may_be_in_no_order(
    num: int, timed: bool, pose: str, level: Level
) -> None:
    rows = [{"name": name, "coarse_pose": pose} for name in NAMES[:num]]
    figures = replace(GOOD, frames=num, exported=num)
    found = _verdict(figures, NAMES[:num], frames=rows, timed=timed)
    assert found.level == level
    assert ("11 stills without times are too few" in found.sentence) == (level == Level.LOOK)


def test_stills_of_each_recording_may_be_too_few_to_tell_their_order() -> None:
    names = tuple(f"{'ab'[n >= 14]}/{n:03d}" for n in range(NUM))
    rows = [{"name": name, "coarse_pose": RunStart.PAIRS} for name in names]
    found = _verdict(GOOD, names, frames=rows, timed=False)
    assert [reason.frames for reason in found.reasons] == [names[14:]]
    assert "6 stills without times are too few" in found.sentence


@pytest.mark.parametrize(
    ("timed", "with_trajectory", "num"), [(True, False, 0), (False, True, 0), (False, False, 1)]
)
def test_recordings_with_times_or_a_trajectory_have_their_order(
    timed: bool, with_trajectory: bool, num: int
) -> None:
    """Whatever the other recordings have; the start that is told is that of all."""
    names = tuple(f"{'ab'[n >= 14]}/{n:03d}" for n in range(NUM))
    rows = [{"name": name, "coarse_pose": RunStart.EARLIER_RUN} for name in names]
    of_a, of_b = ({"name": name, "timed": False, "with_trajectory": False} for name in "ab")
    of_b |= {"timed": timed, "with_trajectory": with_trajectory}
    found = _verdict(GOOD, names, frames=rows, timed=False, recordings=[of_a, of_b])
    assert [reason.frames for reason in found.reasons] == num * [names[14:]]


def test_a_step_that_two_frames_alone_show_is_to_be_looked_at() -> None:
    steps = [("004", "005"), ("018", "019")]
    found = _verdict(replace(GOOD, exported=NUM - 1), NAMES[:-1], lone_steps=steps)
    assert [one.frames for one in found.reasons if "two frames alone" in one.cause] == [
        ("004", "005")
    ]


def test_a_frame_whose_points_fit_far_worse_is_to_be_looked_at() -> None:
    rows = [{"name": name, "median_residual_deg": 0.016} for name in NAMES]
    rows[3]["median_residual_deg"] = None  # it has no points
    assert _verdict(GOOD, frames=rows).level == Level.GOOD
    rows[7]["median_residual_deg"] = 0.031
    assert _verdict(GOOD, frames=rows).level == Level.GOOD
    rows[7]["median_residual_deg"] = 0.063
    (reason,) = _verdict(GOOD, frames=rows).reasons
    assert (reason.level, reason.frames, reason.leave_out) == (Level.LOOK, ("007",), True)
    assert "3.9 times worse" in reason.cause
    names = tuple(f"{'ab'[n >= 14]}/{n:03d}" for n in range(NUM))  # b: a camera of fewer pixels
    rows = [{"name": name, "median_residual_deg": (0.01, 0.05)[name > "b"]} for name in names]
    assert _verdict(GOOD, names, frames=rows).level == Level.GOOD


def test_a_frame_that_few_points_hold_is_to_be_looked_at() -> None:
    rows = [{"name": name, "observations": 700} for name in NAMES]
    rows[0]["observations"] = 200
    assert _verdict(GOOD, frames=rows).level == Level.GOOD
    rows[0]["observations"] = 22  # of a frame that was off by half of the walk
    (reason,) = _verdict(GOOD, frames=rows).reasons
    assert (reason.level, reason.frames, reason.leave_out) == (Level.LOOK, ("000",), True)
    assert not _verdict(replace(GOOD, unrefined=(0,)), frames=rows).reasons[1:]


def test_a_doubted_order_is_told_first() -> None:
    found = _verdict(replace(GOOD, exported=NUM - 1), NAMES[1:], timed=True, order_doubted=True)
    assert found.level == Level.LOOK
    assert "neighbours by the times given are hardly more alike" in found.sentence


def test_lengths_are_metres_where_the_scale_is_known_and_the_camera_is_named() -> None:
    camera = {"taken": True, "reason": "", "baseline": 0.052, "metres_per_unit": 0.6}
    camera |= {"readout": {"taken": True, "ms": 13.24}}
    sentence = _verdict(replace(GOOD, extent_metres=11.0), camera=camera).sentence
    assert "up to 4.4 mm (0.04 % of the path's extent)" in sentence
    assert sentence.endswith("; two lenses 31.2 mm apart, rows read in 13.2 ms")
    for_rows = _verdict(GOOD, camera=camera | {"reason": "one centre is as likely"}).sentence
    assert for_rows.endswith("; two lenses in one place, rows read in 13.2 ms")
    one = _verdict(GOOD, camera={"taken": False}).sentence
    assert one.endswith("; the camera has one centre")


@pytest.mark.parametrize(
    ("figures", "level", "frames", "cause"),
    [
        ({"held_steps": (3,)}, Level.LOOK, "003 004", "no image shows 1 of 19 steps: there the"),
        ({"held_steps": tuple(range(9))}, Level.LOOK, None, "no image shows 9 of 19 steps"),
        ({"held_steps": tuple(range(10))}, Level.REFUSED, None, "no image shows 10 of 19 steps"),
        (
            {"held_steps": tuple(range(9)), "false_steps": 3},
            Level.REFUSED,
            None,
            "though images contradict it at 3 others",
        ),
        ({"held_steps": (3,), "false_steps": 9}, Level.LOOK, None, "contradict it at 9 others"),
        (
            {"held_steps": (3,), "false_steps": 10},
            Level.REFUSED,
            None,
            "contradict it at 10 others",
        ),
        ({"unrefined": (5, 6)}, Level.LOOK, "005 006", "the pose is that of the odometry"),
        (
            LOOSE,
            Level.LOOK,
            "002 003",
            "1 of 19 steps: what lies behind may be larger or smaller by up to 5.3 %",
        ),
        (
            {"scale_changes": (0.0, math.inf), "moved_by_scale": (0.0, math.inf)},
            Level.LOOK,
            "001 002",
            "smaller by any factor",
        ),
        ({"position_error": 0.02}, Level.LOOK, "", "may be off by 2 % of the path's extent"),
        ({"position_error": 0.2}, Level.REFUSED, "", "may be off by 20 % of the path's extent"),
        ({"position_error": math.nan}, Level.LOOK, "", "may be off is not known"),
        ({"deviations": (0.3, *(0.0,) * 18)}, Level.LOOK, "000 001", "contradict 1 of 19 steps"),
        ({"overlaps": (0.9, 0.3, 0.9)}, Level.LOOK, "001 002", "both frames of 1 of 19 steps"),
        ({"deviations": (0.3,) * 19}, Level.REFUSED, None, "contradict 19 of 19 steps"),
        ({"points": 0}, Level.REFUSED, "", "the camera turned on the spot"),
    ],
)
def test_each_failed_test_names_place_cause_and_remedy(
    figures: dict[str, Any], level: Level, frames: str | None, cause: str
) -> None:
    found = _verdict(replace(GOOD, **figures))
    (reason,) = found.reasons
    assert (found.level, reason.level) == (level, level)
    assert cause in reason.cause and reason.remedy
    assert frames is None or " ".join(reason.frames) == frames
    assert found.sentence.startswith(f"{level}: ")
    assert ("positions may be off by up to" in found.sentence) == (
        cause.startswith("may be off by 2 %")
    )


@pytest.mark.parametrize(
    ("loose", "start", "level"),
    [(10, "PAIRS", "REFUSED"), (9, "PAIRS", "LOOK"), (10, "ODOMETRY", "LOOK")],
)
def test_images_alone_make_no_map_of_which_most_steps_leave_the_scale_open(
    loose: int, start: str, level: str
) -> None:
    open_at = (math.inf,) * loose
    figures = replace(GOOD, scale_changes=open_at, moved_by_scale=open_at)
    assert _verdict(figures, start=RunStart[start]).level == Level[level]


@pytest.mark.parametrize(("inside", "level"), [(19, Level.LOOK), (9, Level.REFUSED)])
def test_frames_that_are_not_exported_are_named(inside: int, level: Level) -> None:
    figures = replace(GOOD, exported=inside)
    maps = [{"reason": None}, {"reason": "too few matches"}]
    found = _verdict(figures, NAMES[:inside], maps=maps)
    (reason,) = found.reasons
    assert (found.level, reason.frames) == (level, NAMES[inside:])
    assert f"tie {NUM - inside} of 20 frames to the exported map" in reason.cause
    assert reason.command == "gsba export RUN --to colmap --map 2"
    assert f"{inside} of 20 frames are in the map" in found.sentence


@pytest.mark.parametrize(("unmatched", "level"), [(4, "LOOK"), (5, "REFUSED")])
def test_a_part_of_frames_far_apart_is_not_to_train_on(unmatched: int, level: str) -> None:
    found = _verdict(replace(GOOD, exported=19, unmatched_steps=unmatched), NAMES[:19])
    assert found.level == Level[level]
    assert (f"{unmatched} of 19 neighbours do not match" in found.sentence) == (level == "REFUSED")
    assert _verdict(replace(GOOD, unmatched_steps=unmatched)).level == Level.GOOD


@pytest.mark.parametrize(("unmatched", "advised"), [(0, False), (1, True)])
def test_where_times_have_a_pause_and_the_way_has_none_even_times_help(
    unmatched: int, advised: bool
) -> None:
    """Stills thinned out where the camera stood: neighbours over a pause are not compared."""
    (reason,) = _verdict(replace(GOOD, exported=19, unmatched_steps=unmatched), NAMES[:19]).reasons
    assert ("give even times (--timestamps FILE)" in reason.remedy) == advised


def test_the_worst_reason_is_the_first_and_gives_the_level() -> None:
    figures = replace(GOOD, held_steps=(3,), position_error=0.3, unrefined=(2,))
    found = _verdict(figures)
    assert [one.level for one in found.reasons] == [Level.REFUSED, Level.LOOK, Level.LOOK]
    assert found.level == Level.REFUSED and "30 %" in found.sentence


def test_steps_at_a_frame_without_matches_are_no_reason_of_their_own_where_points_span_it() -> None:
    dim = replace(GOOD, unrefined=(5,), held_steps=(4, 5))
    (reason,) = _verdict(dim).reasons
    assert reason.leave_out and reason.frames == ("005",)
    assert reason.command == "gsba export RUN --to colmap --without doubted"
    assert "; 005: hardly any matches" in _verdict(dim).sentence
    parted = replace(dim, moved_by_scale=(0.0, 0.0, 0.0, 0.0, math.inf, 0.0))
    assert [one.frames for one in _verdict(parted).reasons if "no image" in one.cause] == [
        ("004", "005")
    ]
    elsewhere = _verdict(replace(dim, held_steps=(4, 5, 9))).reasons
    assert [one.frames for one in elsewhere] == [("005",), ("009", "010")]
    refused = _verdict(replace(dim, held_steps=tuple(range(10))))
    assert refused.level == Level.REFUSED and "shows 10 of 19" in refused.sentence


def test_many_frames_are_counted_in_a_line() -> None:
    found = _verdict(replace(GOOD, held_steps=tuple(range(9))))
    assert found.reasons[0].line().startswith("000 to 009 (10 frames): no image shows")
    assert found.to_json()["reasons"][0]["line"] == found.reasons[0].line()


def test_a_change_of_scale_moves_the_smaller_side_of_a_walk() -> None:
    walk = np.column_stack([np.arange(5.0), [0.0, 0.0, 0.0, 0.0, 3.0], np.zeros(5)])
    np.testing.assert_allclose(_smaller_sides(walk), [0.0, 1.0, 2.0, 0.0], rtol=1e-12)


def test_without_a_joint_distribution_covariances_bound_positions() -> None:
    sigma, walk = 0.01, walk_result()
    num, rng = len(walk.world_T_rigs), np.random.default_rng(2)
    covariances = np.tile(np.eye(6) * sigma**2, (num, 1, 1))
    statuses = np.full(num, PoseStatus.REFINED)
    own = replace(walk, pose_covariances=covariances, pose_statuses=statuses)
    draws = rng.normal(0, sigma, (400, num, 6)).astype(np.float32)
    joint = replace(own, joint_errors=JointErrors(np.zeros((num - 1, 6, 6)), draws))
    assert 0.8 * _position_error(joint) < _position_error(own) < 2 * _position_error(joint)
    assert math.isnan(_position_error(replace(own, pose_covariances=covariances * math.nan)))
