"""Rotations that rates add up to."""

import numpy as np
import pytest
from riding_gyro import BIAS, IMU_R_RIG, OFFSET_S, ride

from gsba.imu.readings import Readings, Sensor


@pytest.mark.parametrize("hz", [100.0, 1000.0])
def test_rates_add_up_to_how_the_camera_turned(hz: float) -> None:
    on = ride()
    readings = on.readings(0.0, hz)
    true = on.rotations(readings.timestamps - OFFSET_S)
    rigs = IMU_R_RIG.T @ readings.turned(Sensor(BIAS, np.ones(3))) @ IMU_R_RIG
    np.testing.assert_allclose(rigs, true[0].T @ true, atol=0.1 / hz**2 * 100)


def test_turned_is_exact_for_a_steady_turn_of_any_length() -> None:
    for num in (2, 3, 17, 100):
        readings = Readings(0.01 * np.arange(num), np.tile([0.0, 0, np.pi], (num, 1)))
        turned = readings.turned(Sensor.ideal())
        angles = np.pi * readings.timestamps
        assert len(turned) == num
        np.testing.assert_allclose(turned[:, 0, 0], np.cos(angles), atol=1e-12)
        np.testing.assert_allclose(turned[:, 1, 0], np.sin(angles), atol=1e-12)


def test_spans_without_a_gap_are_covered() -> None:
    times = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 2, 0.01)])
    readings = Readings(times, np.zeros((len(times), 3)))
    spans = np.array([[0, 0.99], [-0.1, 0.5], [0.5, 1.2], [0.9, 1.6], [1.2, 1.3], [1.5, 1.99]])
    assert readings.covers(spans).tolist() == [True, False, False, False, False, True]
    assert not readings.covers(np.array([[1.9, 2.1]])).any()


def test_a_mean_rate_is_that_of_a_line_in_between() -> None:
    times = 0.005 * np.arange(200)
    readings = Readings(times, np.column_stack([3 * times, 0 * times, 1 - times]))
    at = np.array([0.2, 0.5011])
    found = readings.mean_rates(at, 0.01)
    np.testing.assert_allclose(found, np.column_stack([3 * at, 0 * at, 1 - at]), atol=1e-4)


def test_noise_is_told_from_motion() -> None:
    found = ride().readings(2e-3).noise()
    assert found == pytest.approx(2e-3, rel=0.1)
    assert ride().readings(0.0).noise() < 3e-4  # of swings by .2 rad/s
