"""Clock, bias and axes of a gyro, from turns that images show."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from riding_gyro import BIAS, IMU_R_RIG, OFFSET_S, SIGMA, UP, Ride, aligned, ride
from scipy.spatial.transform import Rotation

from gsba.imu.alignment import Alignment, align, turning_of
from gsba.imu.readings import Readings, Sensor
from gsba.trajectory.clock import Clock
from gsba.types import Counts


@cache
def _usual(seed: int = 0) -> Alignment:
    """Alignment of a ride's own readings."""
    on = ride(seed=seed)
    return aligned(on, on.readings())


def _off_deg(found: Alignment) -> float:
    return float(np.rad2deg(Rotation.from_matrix(found.rig_R_imu @ IMU_R_RIG).magnitude()))


@pytest.mark.parametrize("seed", range(3))
def test_clock_bias_and_axes_are_found_from_turns(seed: int) -> None:
    found = _usual(seed)
    assert found.reason == ""
    # Turns of .1 degrees at up to 18 degrees per second tell the clock to some milliseconds,
    # within the deviation that is claimed.
    assert abs(found.clock.offset - OFFSET_S) < min(0.003, 2 * found.offset_sigma)
    assert found.clock.rate == 1
    np.testing.assert_allclose(found.sensor.bias, BIAS, atol=np.deg2rad(0.1))
    assert _off_deg(found) < 3 * np.rad2deg(found.axes_sigma) < 2
    assert found.noise == pytest.approx(SIGMA, rel=0.3)
    assert found.explained > 0.8  # noise of 49 turns leaves some beyond three deviations


def test_better_turns_tell_more_from_where_worse_ones_ended() -> None:
    on, first = ride(), _usual()
    better = aligned(on, on.readings(), 0.0, first)
    assert abs(better.clock.offset - OFFSET_S) < 1e-4
    assert _off_deg(better) < 0.02 < _off_deg(first)
    assert better.noise < 0.1 * first.noise


class _Walk(Ride):
    """A ride whose heading changes more than its tilt."""

    def rotations(self, times: np.ndarray) -> np.ndarray:
        swings = np.sin(2 * np.pi * times[:, None] * [0.03, 0.071, 0.23] + self.seed)
        heading = np.deg2rad(swings @ [60.0, 40.0, 25.0])
        return Rotation.from_rotvec(-heading[:, None] * UP).as_matrix() @ super().rotations(times)


@pytest.mark.parametrize("seed", range(2))
def test_left_handed_axes_are_named(seed: int) -> None:
    """They explained three quarters of the turns, with rates that were 10 degrees/s off."""
    on = _Walk(100.0 + 0.5 * np.arange(120), seed)
    readings = on.readings()
    assert aligned(on, readings).reason == ""
    for signs, axes in ((1, [1, 0, 2]), (1, [0, 2, 1]), (-1, [0, 1, 2])):
        found = aligned(on, replace(readings, rates=signs * readings.rates[:, axes]))
        assert "left-handed" in found.reason


def test_a_gyro_that_shows_too_much_is_found_out() -> None:
    """By as much as they do: its axes by -1, +1.5 and +2 percent."""
    on, scales = ride(), np.array([0.99, 1.015, 1.02])
    readings = on.readings()
    readings = replace(readings, rates=BIAS + scales * (readings.rates - BIAS))
    found = aligned(on, readings, 0.0, aligned(on, readings))
    np.testing.assert_allclose(found.sensor.scales * scales, 1, atol=2e-3)
    said = turning_of(readings, found, on.timestamps)
    true = Rotation.from_matrix(on.steps()).as_rotvec()
    np.testing.assert_allclose(said.steps, true, atol=1e-3)


def test_a_clock_that_runs_fast_is_followed() -> None:
    on = ride(200)
    readings = on.readings()
    begin = on.timestamps[0] + OFFSET_S
    drifting = replace(readings, timestamps=begin + 1.001 * (readings.timestamps - begin))
    found = aligned(on, drifting)
    assert found.reason == ""
    assert found.clock.rate == pytest.approx(1.001, abs=5e-5)
    assert found.clock.offset == pytest.approx(OFFSET_S, abs=0.005)


def test_steps_of_dense_frames_and_unseen_ones() -> None:
    """Ten frames a second, a third of the steps unknown."""
    on = ride(300, 0.1)
    known = np.arange(299) % 3 > 0
    steps = on.steps(SIGMA)
    steps[~known] = np.eye(3)
    found = align(on.timestamps, steps, known, on.readings())
    assert found.reason == "" and abs(found.clock.offset - OFFSET_S) < 0.005
    assert found.counts.kept == known.sum()


def test_what_a_gyro_says_of_frames_is_how_they_turn() -> None:
    on = ride()
    readings = on.readings()
    exact = aligned(on, readings, 0.0, _usual())
    said = turning_of(readings, exact, on.timestamps)
    true = Rotation.from_matrix(on.steps()).as_rotvec()
    # White noise of .001 rad/s at 200 Hz adds up to 5e-5 rad in half a second.
    np.testing.assert_allclose(said.steps, true, atol=3e-4)
    np.testing.assert_allclose(said.rates, on.rates(on.timestamps), atol=3e-3)
    off = np.sqrt(np.mean((said.rates - on.rates(on.timestamps)) ** 2))
    assert 0.3 < off / said.rate_sigma < 1.5
    assert np.isfinite(said.step_sigmas).all()


def test_the_last_step_turns_where_fast_readings_end_with_the_frames() -> None:
    """Readings 1 ms apart are thinned out; the last one is not lost."""
    frames, rate = np.array([0.0, 1.0, 2.0, 3.0, 4.0015]), 0.5
    times = 0.001 * np.arange(4003)
    readings = Readings(times, np.tile([0.0, rate, 0.0], (len(times), 1)))
    clock, counts = Clock(0.0, 0.0, 1.0), Counts(4, 4, "steps")
    found = Alignment(clock, 1e-4, Sensor.ideal(), np.eye(3), 1e-3, 1e-3, 1.0, counts)
    said = turning_of(readings, found, frames)
    assert np.isfinite(said.step_sigmas).all()
    np.testing.assert_allclose(said.steps[:, 1], rate * np.diff(frames), atol=1e-9)


def test_where_readings_end_or_pause_nothing_is_said() -> None:
    on = ride()
    readings = on.readings()
    at = readings.timestamps - OFFSET_S
    begin, pause, end = on.timestamps[3] + 0.2, on.timestamps[20], on.timestamps[40] + 0.2
    kept = (at > begin) & (at < end) & (np.abs(at - pause) > 0.1)
    some = Readings(readings.timestamps[kept], readings.rates[kept])
    found = aligned(on, some)
    assert found.reason == ""
    said = turning_of(some, found, on.timestamps)
    unknown = np.flatnonzero(~np.isfinite(said.step_sigmas))
    np.testing.assert_array_equal(unknown, [0, 1, 2, 3, 19, 20, *range(40, 49)])
    silent = np.flatnonzero(np.isnan(said.rates).any(axis=1))
    np.testing.assert_array_equal(silent, [0, 1, 2, 3, 20, *range(41, 50)])


@pytest.mark.parametrize("seed", range(2))
def test_another_ride_is_not_believed(seed: int) -> None:
    found = aligned(ride(seed=seed), ride(seed=seed + 10).readings())
    assert "at no clock offset" in found.reason


def test_a_mirrored_sensor_is_not_believed() -> None:
    on = ride()
    readings = on.readings()
    found = aligned(on, replace(readings, rates=readings.rates * np.array([1, 1, -1.0])))
    assert found.reason


def test_turns_too_poor_to_tell_are_named() -> None:
    on = ride(4)
    assert "rotations are known from images" in aligned(on, on.readings()).reason
    on, noise = ride(), np.random.default_rng(0).normal(0, SIGMA, (49, 3))
    still = Rotation.from_rotvec(noise).as_matrix()
    assert "too little" in align(on.timestamps, still, np.ones(49, bool), on.readings()).reason


def test_turns_about_one_axis_tell_no_axes() -> None:
    times = 0.5 * np.arange(50)
    swing = np.deg2rad(20) * np.sin(0.9 * times + np.sin(0.31 * times))
    turns = Rotation.from_rotvec(np.diff(swing)[:, None] * [0, 1.0, 0])
    noise = np.random.default_rng(0).normal(0, SIGMA, (49, 3))
    steps = (turns * Rotation.from_rotvec(noise)).as_matrix()
    fine = np.arange(-1, 26, 0.005)
    angle = np.deg2rad(20) * np.sin(0.9 * fine + np.sin(0.31 * fine))
    rates = np.gradient(angle, fine)[:, None] * [0, 0.6, 0.8]
    found = align(times, steps, np.ones(49, bool), Readings(fine, rates))
    assert "one axis" in found.reason
