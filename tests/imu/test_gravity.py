"""The vertical from an accelerometer on a walk."""

import numpy as np
import pytest
from riding_gyro import IMU_R_RIG, UP, aligned, ride

from gsba.imu.alignment import Alignment, up_axis
from gsba.imu.readings import Readings

RIDE = ride()
READINGS = RIDE.readings()


@pytest.fixture(scope="module")
def known() -> Alignment:
    """Alignment of the readings, by exact turns."""
    return aligned(RIDE, READINGS, 0.0, aligned(RIDE, READINGS, 1e-3))


def _up(known: Alignment, forces: np.ndarray | None) -> np.ndarray | None:
    readings = Readings(READINGS.timestamps, READINGS.rates, forces)
    return up_axis(readings, known, RIDE.timestamps, RIDE.rotations(RIDE.timestamps))


def _braking() -> np.ndarray:
    forces = READINGS.forces.copy()
    forces[1000:1800] += 4 * IMU_R_RIG[:, 0]
    return forces


@pytest.mark.parametrize(
    ("forces", "most_deg"),
    [
        (READINGS.forces, 0.1),  # strides left over
        (READINGS.forces + np.array([0.05, 0, 0]) @ IMU_R_RIG.T, np.rad2deg(0.05 / 9.8) + 0.1),
        (_braking(), 0.5),
    ],
    ids=["plain", "a biased accelerometer", "braking for four seconds of 25"],
)
def test_up_is_found(known: Alignment, forces: np.ndarray, most_deg: float) -> None:
    found = _up(known, forces)
    assert found is not None and np.rad2deg(np.arccos(np.clip(found @ UP, -1, 1))) < most_deg


def test_no_accelerometer_and_none_that_shows_weight(known: Alignment) -> None:
    assert _up(known, None) is None
    assert _up(known, 0.01 * READINGS.forces) is None


@pytest.mark.parametrize("axes", [[1, 0, 2], [2, 0, 1], [0, 2, 1]])
def test_an_accelerometer_with_other_axes_than_the_gyro_is_refused(
    known: Alignment, caplog: pytest.LogCaptureFixture, axes: list[int]
) -> None:
    """The vertical was 80 to 120 degrees off."""
    forces = (READINGS.forces @ IMU_R_RIG)[:, axes] @ IMU_R_RIG.T
    assert _up(known, forces) is None
    assert "check that its axes are those of the gyro" in caplog.text
