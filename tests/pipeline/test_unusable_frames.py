"""A walk with frames that cannot be matched, as a covered lens or a damaged video leaves them."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from tiny_run import NUM_FRAMES, PLAIN, WIDTH, Case, computed_stages

from gsba import refine
from gsba.evaluate.trajectory import evaluate
from gsba.report.maps import format_outcome
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

UNUSABLE = "000003", "000005"


def _walk(case: Case, to: Path, black: Sequence[str], others: Sequence[str]) -> Path:
    """The tiny walk with black frames, and frames of something else."""
    shutil.copytree(case.frames, to)
    size = WIDTH // 2, WIDTH, 3
    for name in black:
        cv2.imwrite(str(to / f"{name}.jpg"), np.zeros(size, np.uint8))
    for name in others:
        noise = np.random.default_rng(int(name)).normal(128, 300, size)
        picture = np.clip(cv2.GaussianBlur(noise, (0, 0), 2.5), 0, 255)
        cv2.imwrite(str(to / f"{name}.jpg"), picture.astype(np.uint8))
    return to


def test_the_frames_beside_an_unusable_one_are_neighbours(case: Case, tmp_path: Path) -> None:
    frames, run = _walk(case, tmp_path / "walk", UNUSABLE[:1], UNUSABLE[1:]), tmp_path / "run"
    result = refine(frames, None, run, PLAIN)
    assert not {*UNUSABLE} & {*result.frames.names} and len(result.frames) == NUM_FRAMES - len(
        UNUSABLE
    )
    assert result.report["summary"]["refined"] == NUM_FRAMES - len(UNUSABLE)
    assert evaluate(read_trajectory(run / "trajectory.tum"), case.truth).ate.rmse < 0.02
    # They are counted and named.
    assert result.partial and result.report["frame_lists"]["unusable"] == [*UNUSABLE]
    (reason,) = (r for r in result.report["verdict"]["reasons"] if "next to nothing" in r["cause"])
    assert reason["frames"] == [*UNUSABLE] and reason["level"] != "good to train"
    assert f"6 of {NUM_FRAMES} frames refined (2 unusable)" in format_outcome(result.report, run)
    assert not computed_stages(refine(frames, None, run, PLAIN))


def test_a_trajectory_gives_an_unusable_frame_a_pose(case: Case, tmp_path: Path) -> None:
    result = refine(
        _walk(case, tmp_path / "walk", UNUSABLE[:1], UNUSABLE[1:]),
        case.slam,
        tmp_path / "run",
        PLAIN,
    )
    assert len(result.frames) == NUM_FRAMES and not result.report["frame_lists"]["unusable"]
    named = {name for reason in result.report["verdict"]["reasons"] for name in reason["frames"]}
    assert named >= {*UNUSABLE}


def test_unusable_frames_that_the_trajectory_lacks(case: Case, tmp_path: Path) -> None:
    """A black one is left out. One of dots that match nothing keeps the pose between those beside
    it, which is said, and how far it is off is not known."""
    slam = read_trajectory(case.slam)
    known = [f for f in range(NUM_FRAMES) if f not in (3, 5)]
    write_tum(tmp_path / "slam.tum", Trajectory(slam.timestamps[known], slam.world_T_rigs[known]))
    frames = _walk(case, tmp_path / "walk", UNUSABLE[:1], ())
    dots = np.full((WIDTH // 2, WIDTH, 3), 128, np.uint8)
    for x in range(WIDTH // 16, WIDTH, WIDTH // 8):
        for y in (WIDTH // 6, WIDTH // 4, WIDTH // 3):
            cv2.circle(dots, (x, y), 5, (255, 255, 255), -1)
    cv2.imwrite(str(frames / "000005.jpg"), dots)
    result = refine(frames, tmp_path / "slam.tum", tmp_path / "run", PLAIN)
    assert result.report["frame_lists"]["unusable"] == ["000003"]
    (row,) = (r for r in result.report["frames"] if r["name"] == "000005")
    assert (
        row["status"] == "unrefined" and row["std_rotation_deg"] is row["std_translation"] is None
    )
    causes = {tuple(r["frames"]): r["cause"] for r in result.report["verdict"]["reasons"]}
    assert causes["000005",] == "hardly any matches: the pose is interpolated"


def test_two_in_a_row_are_left_out_together(case: Case, tmp_path: Path) -> None:
    names = ["000003", "000004"]
    frames = _walk(case, tmp_path / "walk", (), names)
    assert refine(frames, None, tmp_path / "run", PLAIN).report["frame_lists"]["unusable"] == names
