"""The vertical from an accelerometer on a walk."""

from dataclasses import replace

import numpy as np
from riding_gyro import IMU_R_RIG, UP, Ride, ride

from gsba.imu.alignment import Alignment, align, up_axis
from gsba.imu.readings import Readings


def _known(on: Ride, readings: Readings) -> Alignment:
    known = np.ones(len(on.timestamps) - 1, bool)
    rough = align(on.timestamps, on.steps(1e-3), known, readings)
    return align(on.timestamps, on.steps(), known, readings, rough)


def _off_deg(found: np.ndarray | None) -> float:
    return float(np.rad2deg(np.arccos(np.clip(found @ UP, -1, 1))))


def test_up_is_found_to_the_bias_of_the_accelerometer() -> None:
    on = ride()
    readings = on.readings()
    poses = on.rotations(on.timestamps)
    assert (
        _off_deg(up_axis(readings, _known(on, readings), on.timestamps, poses)) < 0.1
    )  # strides left over
    biased = replace(readings, forces=readings.forces + np.array([0.05, 0, 0]) @ IMU_R_RIG.T)
    off = _off_deg(up_axis(biased, _known(on, biased), on.timestamps, poses))
    assert off < np.rad2deg(0.05 / 9.8) + 0.1


def test_braking_for_some_seconds_is_an_outlier() -> None:
    on = ride()
    readings = on.readings()
    forces = readings.forces.copy()
    forces[1000:1800] += 4 * IMU_R_RIG[:, 0]  # four seconds of 25
    found = up_axis(
        replace(readings, forces=forces),
        _known(on, readings),
        on.timestamps,
        on.rotations(on.timestamps),
    )
    assert _off_deg(found) < 0.5


def test_no_accelerometer_and_none_that_shows_weight() -> None:
    on = ride()
    readings = on.readings()
    found, poses = _known(on, readings), on.rotations(on.timestamps)
    assert up_axis(replace(readings, forces=None), found, on.timestamps, poses) is None
    falling = replace(readings, forces=0.01 * readings.forces)
    assert up_axis(falling, found, on.timestamps, poses) is None
