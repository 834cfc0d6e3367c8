"""GPS fixes that are late, early or mirrored, told by the shapes of both paths."""

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
from lasting_errors import fixes_at, lasting_errors
from scipy.spatial.transform import Rotation
from walk_on_earth import frame_set, geodetic_of, walk_result, write_fixes

from gsba.config import PlacementSettings
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.placement import fixes_of_frames
from gsba.placement import placement as placing
from gsba.placement.gps import local_from_geodetic
from gsba.placement.gps_shape import are_mirrored, lag_of
from gsba.placement.placement import place
from gsba.placement.world import Placement
from gsba.similarity import Sim3

NUM, STEP_S, SPEED = 240, 0.5, 1.3  # frames, seconds, m/s
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()


def _walk(rng: np.random.Generator) -> np.ndarray:
    """Positions (F, 3) of a walk around blocks, metres, with bends at random."""
    turned = np.cumsum(rng.normal(0, 0.03, NUM)) + np.pi / 2 * (np.arange(NUM) // 50)
    steps = SPEED * STEP_S * np.column_stack([np.cos(turned), np.sin(turned), 0 * turned])
    return np.cumsum(steps, axis=0) + np.array([0, 0, 1.6])


@pytest.mark.parametrize("level", [True, False])
@pytest.mark.parametrize("late", [0.0, 6.0, -18.0])
def test_a_clock_that_is_off_is_found(late: float, level: bool) -> None:
    times = STEP_S * np.arange(NUM)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        path = _walk(rng)
        shown = np.column_stack([np.interp(times - late, times, column) for column in path.T])
        inside = (times - late >= 0) & (times - late <= times[-1])
        fixes = fixes_at(shown + lasting_errors(times, rng), times).taken(inside)
        run = 0.2 * path @ (np.eye(3) if level else TURN.T)
        assert lag_of(fixes, times, run, level) == pytest.approx(late, abs=1.0 if late else 1e-9)


def test_a_straight_walk_tells_no_lag() -> None:
    times = STEP_S * np.arange(NUM)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        speed = SPEED * (1 + 0.15 * np.sin(times / 7))
        path = np.column_stack([np.cumsum(speed * STEP_S), 0 * times, 0 * times])
        fixes = fixes_at(path + 0.2 * lasting_errors(times, rng), times)
        run = path * (1 + 0.03 * (times / times[-1]))[:, None]  # its scale drifts by 3 %
        assert lag_of(fixes, times, run, level=True) == 0


def test_a_mirrored_file_is_told() -> None:
    times, rng = STEP_S * np.arange(NUM), np.random.default_rng(1)
    path = _walk(rng)
    fixes = fixes_at(path + lasting_errors(times, rng), times)
    assert not are_mirrored(fixes, 0.2 * path)
    swapped = dataclasses.replace(fixes, positions=fixes.positions[:, [1, 0, 2]])
    assert are_mirrored(swapped, 0.2 * path)


@pytest.mark.parametrize("late", [0.0, 18.0])
def test_a_run_is_placed_in_spite_of_a_clock_that_is_off(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, late: float
) -> None:
    """By fixes that are GPS time, 18 s ahead of UTC, north was off by 20 of its sigmas."""
    times, rng = STEP_S * np.arange(NUM), np.random.default_rng(3)
    path = _walk(rng)
    frames = pose(Rotation.from_rotvec(rng.normal(0, 0.3, (NUM, 3))).as_matrix(), path)
    whole = dataclasses.replace(walk_result(NUM), world_T_rigs=frames)
    run = Placement(Sim3(0.21, TURN)).apply(whole)
    geodetic = geodetic_of(path + lasting_errors(times, rng))
    file = write_fixes(tmp_path / "gps.csv", times + late, geodetic)
    with caplog.at_level(logging.WARNING):
        placed = place(run, frame_set(NUM), PlacementSettings(gps=str(file)))
    said, turn = placed.grounds["gps"], placed.similarity.rotation @ TURN
    assert said["lag_s"] == pytest.approx(late, abs=1.0 if late else 1e-9)
    assert bool(late) == ("s behind the frames by the shapes of both" in caplog.text)
    north_off = np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))
    assert abs(north_off) < 3 * said["heading_sigma_deg"]
    assert abs(0.21 * placed.similarity.scale - 1) < 3 * 0.21 * said["scale_sigma"]


def test_a_mirrored_file_is_refused_where_up_is_known(tmp_path: Path) -> None:
    times, rng = STEP_S * np.arange(NUM), np.random.default_rng(4)
    path = _walk(rng)[:120]
    run = dataclasses.replace(
        walk_result(120), world_T_rigs=pose(np.tile(np.eye(3), (120, 1, 1)), path)
    )
    geodetic = geodetic_of((path + lasting_errors(times[:120], rng)) * [-1.0, 1, 1])
    file = write_fixes(tmp_path / "gps.csv", times[:120], geodetic)
    upright = Placement(Sim3(rotation=np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])), up="-y")
    fixes = fixes_of_frames(str(file), frame_set(120))
    with pytest.raises(GsbaError, match=r"gps\.csv: its positions fit the mirror image"):
        placing._on_earth(run, frame_set(120), file, fixes, upright)


def test_frames_beyond_the_fixes_are_less_certain(tmp_path: Path) -> None:
    """Sigmas were those of the frames with fixes alone, here the first half of a walk."""
    times, rng = STEP_S * np.arange(NUM), np.random.default_rng(5)
    path, errors = _walk(rng), []
    turns = Rotation.from_rotvec(rng.normal(0, 0.3, (NUM, 3))).as_matrix()
    run = dataclasses.replace(walk_result(NUM), world_T_rigs=pose(turns, path))
    for _ in range(20):
        some = (path + lasting_errors(times, rng))[: NUM // 2]
        file = write_fixes(tmp_path / "gps.csv", times[: NUM // 2], geodetic_of(some))
        placed = place(run, frame_set(NUM), PlacementSettings(gps=str(file)))
        assert placed.origin is not None
        off = placed.similarity.points(path) - local_from_geodetic(
            geodetic_of(path), np.array(placed.origin)
        )
        errors.append(np.abs(off).max(axis=0) / placed.grounds["gps"]["largest_position_sigma_m"])
    assert np.sqrt(np.mean(np.square(errors))) < 1.5
