"""Lenses in about one place, whose rows are read one after another: kept for their rows."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from gsba.bundle.lens_centres import LensCentres
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.shared_parameters import ObservedRays
from gsba.camera.lens import Lenses
from gsba.config import CameraSettings
from gsba.pipeline import camera
from gsba.types import Counts

ONE = Lenses()
FOUND = np.array([1e-5, 0.0, 2e-5])
CENTRES = LensCentres(
    Lenses(),
    FOUND,
    1e-8 * np.eye(3),
    np.zeros(4),
    "one centre is as likely",
    Counts(0, 0, "observations"),
)


def _kept(
    monkeypatch: pytest.MonkeyPatch, reason: str, settings: CameraSettings, lenses: Lenses = ONE
) -> LensCentres:
    read = CameraEstimate(Lenses(), reason=reason)
    monkeypatch.setattr(camera.readout, "estimate", lambda _: read)
    monkeypatch.setattr(camera.lens_centres, "estimate", lambda _: CENTRES)
    rays = ObservedRays(*3 * [MagicMock()], lenses)
    return camera._centres(rays, settings.baseline() is not None)


def test_a_readout_keeps_estimated_centres_and_the_reason(monkeypatch) -> None:
    kept = _kept(monkeypatch, "", CameraSettings())
    assert kept.lenses and np.array_equal(kept.lenses.centre, FOUND)
    assert kept.reason == CENTRES.reason


def test_one_centre_stays_without_a_readout(monkeypatch) -> None:
    assert _kept(monkeypatch, "motion does not predict unseen parts", CameraSettings()) is CENTRES


def test_lenses_that_settings_put_apart_are_not_kept_for_rows(monkeypatch) -> None:
    assert _kept(monkeypatch, "", CameraSettings(baseline_mm=32.0)) is CENTRES


def test_raw_lenses_that_are_not_told_apart_stay_so(monkeypatch) -> None:
    raw = Lenses(np.zeros(3), reference_calibration=MagicMock())
    assert _kept(monkeypatch, "", CameraSettings(), raw) is CENTRES
