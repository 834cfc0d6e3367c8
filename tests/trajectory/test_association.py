"""Frames meet the trajectory in time: exact, between, beyond, and on another clock."""

from pathlib import Path

import numpy as np
import pytest
from plain_records import frames_of
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.config import ReadSettings, RefineSettings
from gsba.frames.scan import scan
from gsba.geometry import inverse, pose, rotation_angle
from gsba.log import GsbaError
from gsba.pipeline.inputs import coarse_poses
from gsba.trajectory.association import associate
from gsba.trajectory.files import read_trajectory
from gsba.types import CoarsePoses, FrameSet, PictureFormat, PoseSource, Trajectory

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="no ../shared/data")
SLAM, INTERPOLATED, EXTRAPOLATED, _ = PoseSource
SPEED, RATE = np.array([0.5, -0.1, 1.0]), np.array([0.02, 0.1, -0.05])  # units/s, rad/s


def frames_at(times: np.ndarray) -> FrameSet:
    names, times = [f"{i:04d}" for i in range(len(times))], np.asarray(times, dtype=np.float64)
    return frames_of(PictureFormat("erp", 64, 32), ((Path("x.jpg"),),) * len(times), times, names)


def motion(times: np.ndarray) -> np.ndarray:
    """Constant velocity, turning at a constant rate: what interpolation reproduces exactly."""
    t = np.asarray(times, dtype=np.float64)[:, None]
    return pose(Rotation.from_rotvec(t * RATE).as_matrix(), t * SPEED)


def coarse(frame_times, entry_times, clock_offset_s: float | None = None) -> CoarsePoses:
    entries = np.asarray(entry_times, dtype=np.float64)
    settings = ReadSettings(clock_offset_s=clock_offset_s)
    return associate(frames_at(frame_times), Trajectory(entries, motion(entries)), settings)


GRID = np.arange(40) / 10


def test_equal_times_take_the_entries() -> None:
    result = coarse(GRID, GRID)
    np.testing.assert_allclose(result.world_T_rigs, motion(GRID), atol=1e-14)
    assert (result.sources == SLAM).all() and result.sources.dtype == np.uint8
    assert result.time_offset == 0


def test_lost_frames_are_interpolated() -> None:
    lost = [7, 20, 21, 22]
    result = coarse(GRID, np.delete(GRID, lost))
    assert np.flatnonzero(result.sources == INTERPOLATED).tolist() == lost
    assert (np.delete(result.sources, lost) == SLAM).all()
    np.testing.assert_allclose(result.world_T_rigs, motion(GRID), atol=1e-12)


def test_denser_trajectory_is_sampled_at_the_frames() -> None:
    frames = np.arange(1, 9) * 0.45
    result = coarse(frames, np.arange(100) / 24)
    assert (result.sources == SLAM).all()
    np.testing.assert_allclose(result.world_T_rigs, motion(frames), atol=1e-12)


def test_ends_continue_the_motion_and_fade() -> None:
    entries = GRID[5:-3]
    result = coarse(GRID, entries)
    assert np.flatnonzero(result.sources == EXTRAPOLATED).tolist() == [*range(5), 37, 38, 39]
    steps = inverse(result.world_T_rigs[:-1]) @ result.world_T_rigs[1:]
    lengths, angles = np.linalg.norm(steps[:, :3, 3], axis=1), rotation_angle(steps[:, :3, :3])
    outward = [4, 3, 2, 1, 0]  # steps before the first entry, going away from it
    for walk in (outward, [36, 37, 38]):
        for values, pace in ((lengths, np.linalg.norm(SPEED)), (angles, np.linalg.norm(RATE))):
            assert (np.diff(values[walk]) < 0).all() and (values[walk] > 0).all()
            assert 0.9 < values[walk[0]] / (0.1 * pace) < 1
    # Half a second back: translation fades by 2 %, rotation by 21 %.
    np.testing.assert_allclose(result.world_T_rigs[0, :3, 3], 0.0, atol=0.03 * 0.5 * 1.2)
    assert rotation_angle(result.world_T_rigs[:1, :3, :3])[0] < 0.25 * 0.5 * np.linalg.norm(RATE)


def test_a_far_end_stays_bounded() -> None:
    result = coarse(np.append(GRID, 1e5), GRID)
    away = result.world_T_rigs[-1, :3, 3] - result.world_T_rigs[-2, :3, 3]
    assert np.linalg.norm(away) < 10.1 * np.linalg.norm(SPEED)


def test_long_gaps_are_reported(caplog) -> None:
    coarse(np.arange(30.0), [0, 1, 2, 3, 4, 20, 21, 22, 23, 24])
    assert "longer than 10 s: 15" in caplog.text and "'0005': 16.0 s" in caplog.text


@pytest.mark.parametrize("offset", [1_700_000_000.25, -5000.0])
def test_offset_of_the_clocks_is_found_when_unique(offset: float, caplog) -> None:
    entries = np.delete(GRID, [3, 4, 11]) + offset
    result = coarse(GRID, entries)
    # Doubles at 1.7e9 s are 2.4e-7 apart.
    assert result.time_offset == pytest.approx(offset, abs=1e-6)
    assert np.flatnonzero(result.sources == INTERPOLATED).tolist() == [3, 4, 11]
    np.testing.assert_allclose(result.world_T_rigs, motion(GRID + offset), atol=1e-5, rtol=1e-9)
    assert "only offset" in caplog.text


def test_offset_is_found_among_irregular_times() -> None:
    frames = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 40))
    assert coarse(frames, frames[5:-4] + 900).time_offset == pytest.approx(900, abs=1e-9)
    dense = np.sort(np.append(frames, frames[:-1] + 0.2))  # more entries than frames
    assert coarse(frames, dense - 900).time_offset == pytest.approx(-900, abs=1e-9)


def test_ambiguous_offset_is_asked_for() -> None:
    entries = GRID[3:] + 5000  # three frames lost at the start, or at the end, or between
    refused(r"several offsets fit, such as .* read\.clock_offset_s", coarse, GRID, entries)
    result = coarse(GRID, entries, clock_offset_s=5000.0)
    assert result.time_offset == 5000
    assert np.flatnonzero(result.sources == EXTRAPOLATED).tolist() == [0, 1, 2]


def test_no_overlap_is_refused_with_both_ranges() -> None:
    message = refused("no offset makes all times meet", coarse, GRID, 100 + np.arange(40) * 0.13)
    assert "0.000000 to 3.900000" in message and "100.000000 to 105.070000" in message
    refused(r"clock_offset_s = 7\.0", coarse, GRID, GRID + 100, clock_offset_s=7.0)


def test_small_overlap_is_trusted_only_if_stated() -> None:
    entries = np.arange(30, 80) * 0.1003
    refused("hardly overlap", coarse, GRID, entries)
    assert (coarse(GRID, entries, clock_offset_s=0.0).sources[:29] == EXTRAPOLATED).all()


def test_part_of_a_video_and_part_of_a_track_need_no_offset() -> None:
    assert coarse(GRID[10:14], GRID).time_offset == 0
    assert coarse(GRID, GRID[10:14]).time_offset == 0


@needs_shared
@pytest.mark.parametrize(
    ("name", "unseen"), [("frame_trajectory", 2), ("other_runs/rect_default_rt_frame", 6)]
)
def test_real_slam_output_with_a_late_start(name: str, unseen: int) -> None:
    frames = scan(SHARED / "aisle_slam" / "images")
    trajectory = read_trajectory(SHARED / "aisle_slam" / f"{name}.txt")
    result = associate(frames, trajectory, ReadSettings())
    assert (result.sources[:unseen] == EXTRAPOLATED).all()
    assert (result.sources[unseen:] == SLAM).all()
    entry = np.searchsorted(trajectory.timestamps, frames.timestamps[10] - 0.01)
    # Times differ by the rounding of a running sum, 1e-13 s.
    np.testing.assert_allclose(result.world_T_rigs[10], trajectory.world_T_rigs[entry], atol=1e-9)


@needs_shared
def test_real_frames_with_mask() -> None:
    folder = SHARED / "apartment"
    frames = scan(folder / "images", masks=folder / "mask.png")
    assert (len(frames), frames.format.width, frames.format.height) == (11, 5376, 2688)
    result = associate(frames, read_trajectory(folder / "coarse.tum"), ReadSettings())
    assert (result.sources == SLAM).all()


@pytest.mark.parametrize("unit", ["milliseconds", "microseconds", "nanoseconds"])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_times_in_another_unit_are_named(unit: str, start: float) -> None:
    factor = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}[unit]
    times, denser = start + np.arange(60) / 2, start + np.arange(900) / 30
    refused(f"trajectory's times look like {unit} .* by 1e", coarse, times, factor * denser)
    refused(f"frames' times look like {unit} .* check --fps, or", coarse, factor * times, denser)


def test_a_unit_is_seen_where_many_poses_fall_into_the_frames_time() -> None:
    """Ten minutes, in which 18 of the poses seem to be: not so few that they would tell."""
    with pytest.raises(GsbaError, match="trajectory's times look like milliseconds"):
        coarse(np.arange(1200) / 2, 1e3 * np.arange(18_000) / 30)


def test_a_clip_of_a_long_trajectory_is_no_other_unit() -> None:
    clip = 200 + np.arange(12) / 25
    assert (coarse(clip, np.arange(4400) / 10).sources != EXTRAPOLATED).all()
    few = coarse(np.arange(1000) / 2, np.array([0.0, 0.5]))  # lost after two frames
    assert np.sum(few.sources == SLAM) == 2


@pytest.mark.parametrize("fps", [0.002, 0.01, 0.1, 200.0])
def test_a_rate_that_leaves_next_to_no_poses_is_refused(fps: float) -> None:
    refused(r"check\s+--fps", coarse, np.arange(12) / fps, np.arange(12) / 2)


def test_times_closer_than_a_clock_tells_are_refused() -> None:
    refused(r"two frames are less than 1e-09 s apart, at 0\.0 s", coarse, [0, 1e-300, 1, 2], GRID)
    refused("two poses are less", coarse, GRID, [0, 1e-310, 1, 2])


@pytest.mark.parametrize("extent", [0.0, 1e-150])
def test_a_trajectory_that_hardly_moves_gives_no_positions(extent: float) -> None:
    poses = motion(GRID)
    poses[:, :3, 3] *= extent
    found = coarse_poses(frames_at(GRID), [Trajectory(GRID, poses)], RefineSettings())
    assert (found.sources == PoseSource.NONE).all()
