"""What a report says of the trajectory that a run was given."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from export_scene import panoramas, poses, reconstruction

from gsba.loop_closure.merged_map import Registered
from gsba.report.findings import of_frames, of_trajectory
from gsba.report.verdict import measure
from gsba.trajectory.judgement import StepChecks
from gsba.types import CoarsePoses, Counts, PoseSource, RunStart, Solution


def test_without_a_trajectory_images_contradict_nothing(tmp_path: Path) -> None:
    frames = panoramas(tmp_path, ".png")
    num = len(frames)
    every = np.ones(num - 1, bool)
    trust = StepChecks.of_all(np.tile(np.eye(4), (num, 1, 1)))
    trust = replace(trust, false_steps=every, unseen_steps=np.arange(num - 1) == 2)
    found, _ = of_trajectory(trust, None, None, (), frames, np.ones(num, bool))
    assert found["false_steps"] == found["false_frames"] == []
    assert found["unseen_steps"] == [[frames.names[2], frames.names[3]]]
    found, _ = of_trajectory(trust, None, None, (), frames)
    assert len(found["false_steps"]) == num - 1


def test_steps_without_a_trajectory_are_no_doubt_of_one_beside(tmp_path: Path) -> None:
    """Of two recordings the first has a trajectory, of which images show all steps but one."""
    frames, result = panoramas(tmp_path, ".png"), reconstruction()
    num, first = len(frames), 4
    names = tuple(f"{'ab'[n >= first]}/{n}" for n in range(num))
    frames = replace(frames, names=names, clock_shifts=(0.0,) * num)
    steps = np.arange(num - 1)
    trust = replace(
        StepChecks.of_all(poses()),
        false_steps=steps >= first - 1,  # have no prior
        unseen_steps=(steps == 1) | (steps == first - 1),
    )
    checks, _ = of_trajectory(trust, None, None, (), frames, np.arange(num) >= first)
    assert checks["false_steps"] == []
    assert checks["unseen_steps"] == checks["held_steps"] == [list(names[1:3])]
    rows = [{"name": name, "coarse_pose": RunStart.TRAJECTORY} for name in names]
    figures = measure(
        {"summary": {"frames": num}, "trajectory": checks, "frames": rows}, result, frames
    )
    assert (figures.held_steps, figures.false_steps) == ((1,), 0)


def test_long_lists_of_frames_are_counted_in_notes_and_named_in_the_report(tmp_path: Path) -> None:
    frames = panoramas(tmp_path, ".png")
    num, result = len(frames), reconstruction()
    assert num > 5
    sources = np.full(num, PoseSource.INTERPOLATED, np.uint8)
    coarse, weights = CoarsePoses(poses(), sources, 0.0), np.ones(num)
    weights[2] = 0.5
    lists, notes = of_frames(frames, coarse, result, weights, 0.01, RunStart.ODOMETRY)
    assert lists["interpolated"] == list(frames.names) and lists["unmatched"] == []
    assert notes == [
        f"no pose of the odometry, the initial pose is interpolated: {num} of {num} frames, "
        "listed in report.json under frame_lists.interpolated",
        f"pixels fit badly and were weighted down: {frames.names[2]}",
    ]


def test_maps_that_are_not_joined_are_no_note_but_a_list(tmp_path: Path) -> None:
    frames = panoramas(tmp_path, ".png")
    num, none = len(frames), np.zeros(len(frames), bool)
    registered = Registered(
        solved=Solution.without_points(poses()),
        components=np.arange(num, dtype=np.int32),
        scales=np.ones(num),
        moves=np.tile(np.eye(4), (num, 1, 1)),
        offsets=np.zeros((num, 3)),
        met=~none,
        alone=none,
        lost=none,
        counts=Counts(num - 1, 0, "parts"),
    )
    found, notes = of_trajectory(StepChecks.of_all(poses()), None, registered, (), frames)
    assert len(found["maps"]) == num and notes == []
