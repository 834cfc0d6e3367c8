"""Rounds of patch alignment: what the adjustment takes back is adjusted without it."""

from unittest.mock import MagicMock

import numpy as np
import pytest

from gsba.bundle import readout
from gsba.bundle.readout import CameraEstimate, CameraEstimates
from gsba.camera.lens import Lenses
from gsba.config import RefineSettings
from gsba.pipeline import camera, frontend, patch_rounds
from gsba.pipeline.state import State


def test_a_readout_that_the_adjustment_takes_back_is_adjusted_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    swept = Lenses(
        np.array([0, 0, 0.05]), row_directions=np.eye(3)[:2], readout_motion=np.ones((3, 6))
    )
    tried, stages = [], []

    def adjust(trial: State, _: object, stage: str) -> tuple[object, object, CameraEstimates]:
        tried.append(trial.map.estimates().each[0])
        stages.append(stage)
        return None, None, trial.map.estimates()

    def state_of(found: CameraEstimates) -> MagicMock:
        state = MagicMock()
        state.map.estimates.return_value = found
        state.map.lenses.parts = found.cameras.parts
        state.with_cameras = state_of
        return state

    false = CameraEstimates((CameraEstimate(swept, 1e-6, 5e-5),))
    monkeypatch.setattr(frontend, "align_gyro_to_map", lambda state, *_, **__: state)
    monkeypatch.setattr(camera, "take_parts_from_patches", lambda state, *_: state)
    monkeypatch.setattr(camera, "adjust_with_patches", adjust)
    monkeypatch.setattr(patch_rounds, "carried", lambda state, *_: state)
    patch_rounds._adjust_under_lenses(state_of(false), MagicMock(), 1)
    assert stages == ["aligned1", "aligned1_instant"]
    assert tried[1].lenses.readout_motion is None and tried[1].reason == readout.VANISHED


@pytest.mark.parametrize(
    ("settled_after", "rounds", "told"), [(3, 3, False), (6, 6, False), (9, 8, True)]
)
def test_rounds_go_on_until_steps_are_settled_and_say_if_they_are_not(
    settled_after: int,
    rounds: int,
    told: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    done, state = [], MagicMock()
    state.run.settings = RefineSettings()
    monkeypatch.setattr(frontend, "align_gyro_to_map", lambda state, *_, **__: state)
    monkeypatch.setattr(patch_rounds, "_round", lambda state, n: done.append(n) or state)
    monkeypatch.setattr(patch_rounds, "is_settled", lambda _, __, n: n > settled_after)
    patch_rounds.align(state)
    assert done == list(range(1, rounds + 1))
    assert ("still moved in the last of 8 rounds" in caplog.text) is told


def test_a_readout_that_was_taken_back_is_not_looked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gone = CameraEstimate(Lenses(np.array([0, 0, 0.05])), reason=readout.VANISHED)
    state, found = MagicMock(), MagicMock()
    found.lenses, found.estimate.return_value = gone.lenses, gone
    state.map.cameras = [found]
    monkeypatch.setattr(camera, "_estimated", MagicMock(side_effect=AssertionError))
    camera.take_parts_from_patches(state, MagicMock(), "aligned2", 0)
