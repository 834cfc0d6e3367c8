"""The metric scale of a map by the lenses of several cameras, some of them of known distance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import LensCentres, baseline_of
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.pipeline import backend
from gsba.placement.placement import metres_per_unit
from gsba.types import Counts

METRES = 2.0  # of a map unit
X5, OSMO, UNKNOWN = CameraSettings(name="insta360-x5"), CameraSettings(name="dji-osmo-360"), None


def _found(metres: float | None) -> FoundCamera:
    """A camera whose lenses are so far apart; None = one centre explains its images."""
    half = np.array([0.0, 0.0, (metres or 0.0) / METRES / 2])
    lenses = Lenses(half) if metres else Lenses()
    counts = Counts(0, 0, "observations")
    return FoundCamera(LensCentres(lenses, half, 1e-9 * np.eye(3), np.zeros(4), "", counts))


def _baseline(
    named: CameraSettings, cameras: list[tuple[CameraSettings | None, float | None]]
) -> tuple[float, float] | None:
    given = [settings or CameraSettings() for settings, _ in cameras]
    run = SimpleNamespace(settings_of=given.__getitem__, settings=SimpleNamespace(camera=named))
    map_ = SimpleNamespace(cameras=[_found(metres) for _, metres in cameras])
    state: Any = SimpleNamespace(run=run, map=map_)
    return backend._baseline(state, 1.0)


@pytest.mark.parametrize(
    "cameras",
    [
        [(X5, 0.032), (OSMO, 0.025)],
        [(X5, None), (OSMO, 0.025)],
        [(UNKNOWN, 0.05), (X5, 0.032)],
    ],
)
def test_any_camera_of_known_distance_gives_the_scale(
    cameras: list[tuple[CameraSettings | None, float | None]],
) -> None:
    """Which exports take by the distance that settings name, those of the first one named."""
    found, known = _baseline(X5, cameras), X5.baseline()
    assert found is not None and known is not None
    assert metres_per_unit(found, known)[0] == pytest.approx(METRES)


def test_lenses_of_unknown_distance_do_not_give_it() -> None:
    """Beside a camera that settings name, whose lenses were not found."""
    found = _baseline(X5, [(X5, None), (UNKNOWN, 0.05)])
    assert found == (pytest.approx(0.05 / METRES), np.inf)
    alone, centres = _baseline(CameraSettings(), [(UNKNOWN, 0.05)]), _found(0.05).centres
    assert centres is not None and alone == baseline_of(centres, 1.0)
    assert _baseline(X5, [(X5, None)]) is None
