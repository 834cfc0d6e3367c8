"""Poses and a splat of their frames in turns: moves that help are taken, others undone."""

import logging
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from splat_moves import HARMS, harmed, run, settings_for, shorten, spoiled
from tiny_run import NUM_FRAMES, Case, computed_stages

from gsba.config_file import load_config
from gsba.evaluate.trajectory import evaluate
from gsba.photometric import direct, patches
from gsba.splat import refinement
from gsba.types import Trajectory


@pytest.fixture(autouse=True)
def _few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


def errors(case: Case, world_T_rigs: np.ndarray):
    return evaluate(Trajectory(case.result.frames.timestamps, world_T_rigs), case.truth)


def test_a_splat_corrects_poses_that_observations_hardly_hold(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, first_steps=80, steps=120, max_moves=2)
    given = spoiled(case, 0.1, 0.003, 50.0)
    result = run(case, given, settings_for(sizes=(48,)))
    move = result.moves[0]
    assert move.accepted and move.evidence > 10 and move.growth + 10 * move.growth_sigma < 1
    # A pose is off by a twentieth of a pixel: two trainings must not differ by more than that does.
    assert abs(move.psnr_moved - move.psnr_stayed) < 0.05 and move.psnr_sigma < 0.03
    before, after = (
        errors(case, poses) for poses in (given[2].world_T_rigs, result.adjustment.world_T_rigs)
    )
    assert after.ate.rmse < 0.3 * before.ate.rmse
    assert after.rpe_rotation_deg.median < 0.3 * before.rpe_rotation_deg.median
    assert (result.counts[0].kept, result.counts[0].dropped["held out"]) == (6, 2)


@pytest.mark.parametrize("harm", HARMS)
def test_a_harmful_move_is_undone(
    case: Case, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, harm: str
) -> None:
    given = spoiled(case, 0.1, 0.003, 50.0)
    shorten(monkeypatch, first_steps=80, steps=40, max_growth=100.0)
    settings = settings_for(sizes=(48,))
    worse = harmed(refinement._Turns._moved, HARMS[harm], 0)
    monkeypatch.setattr(refinement._Turns, "_moved", worse)
    with caplog.at_level(logging.INFO, "gsba"):
        result = run(case, given, settings)
    (move,) = result.moves
    assert not move.accepted and move.evidence < -5
    np.testing.assert_array_equal(result.adjustment.world_T_rigs, given[2].world_T_rigs)
    assert "standard error" in caplog.text and "undone" in caplog.text


def test_a_move_of_nothing_has_no_evidence_and_is_undone(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = harmed(refinement._Turns._moved, lambda steps, rng: 0 * steps, 0)
    monkeypatch.setattr(refinement._Turns, "_moved", still)
    (move,) = run(case, spoiled(case, 0.0, 0.0, 1.0), settings_for(sizes=(48,))).moves
    assert not move.accepted and move.evidence == 0 and move.growth == 1


def test_evidence_of_tiny_moves_is_a_matter_of_chance(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thousandth of the helpful move, away from poses that fit their observations: one in forty
    passes by chance, so the median of nine is asked, which is beyond two once in 25,000 times."""
    given = spoiled(case, 0.0, 0.0, 1.0)
    real, evidence = refinement._Turns._moved, []
    for seed in range(9):
        tiny = harmed(real, lambda steps, rng: rng.normal(0, 1e-6, (8, 6)), seed)
        monkeypatch.setattr(refinement._Turns, "_moved", tiny)
        evidence.append(run(case, given, settings_for()).moves[0].evidence)
    assert 0 < np.median(np.abs(evidence)) < 2


def test_a_move_that_observations_contradict_is_undone(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, max_growth=1e-6)
    given = spoiled(case, 0.0, 0.0, 1.0)
    result = run(case, given, settings_for())
    assert [move.accepted for move in result.moves] == [False]
    np.testing.assert_array_equal(result.adjustment.world_T_rigs, given[2].world_T_rigs)
    assert not result.adjustment.rounds[-1].accepted


def test_few_frames_are_left_as_they_were(
    case: Case, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, held_out_every=NUM_FRAMES)
    given = spoiled(case, 0.0, 0.0, 1.0)
    result = run(case, given, settings_for())
    assert result.adjustment is given[2] and result.moves == ()
    assert "too few" in caplog.text


def test_an_interrupted_refinement_goes_on_to_the_same_result(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, settings = spoiled(case, 0.1, 0.003, 50.0), settings_for(sizes=(24, 32))
    whole = run(case, given, settings)
    real, calls = refinement._Turns.turn, []

    def turn(self, before):
        calls.append(before.turns)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, before)

    monkeypatch.setattr(refinement._Turns, "turn", turn)
    kept = {"checkpoint": tmp_path / "turns.npz", "key": "these"}
    with pytest.raises(KeyboardInterrupt):
        run(case, given, settings, **kept)
    again = run(case, given, settings, **kept)
    assert calls == [-1, 0, -1, -1, 0]  # the training and the move of the first size are kept
    assert again.moves == whole.moves
    np.testing.assert_array_equal(again.adjustment.world_T_rigs, whole.adjustment.world_T_rigs)
    run(case, given, settings, checkpoint=tmp_path / "turns.npz", key="others")
    assert calls[5:] == [-1, 0, -1, 0]


@pytest.mark.slow
def test_a_run_with_all_families(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = case.copy(tmp_path / "run")
    settings = settings_for(("bearing", "photometric", "splat"))
    monkeypatch.setattr(direct, "_DEPTH_LEVELS", 0)
    monkeypatch.setattr(patches, "_SPACING_DEG", 20.0)
    result = case.refine(out, settings)
    assert computed_stages(result)[:2] == ["photometric", "splat"]
    (move,) = result.report["splat"]
    assert move["size"] == 24 and move["psnr_stayed"] > 12 and move["psnr_sigma"] > 0
    costs = result.report["solver"][-1]["rounds"][-1]["iterations"][0]["costs"]
    assert set(costs) == {"graph", "bearing", "photometric", "splat"}
    stage = next(s for s in result.report["stages"] if s["name"] == "splat")
    assert stage["counts"][0]["dropped"] == {"held out": 2, "unrefined": 0}
    assert case.errors(out).ate.rmse < 1.2 * case.errors().ate.rmse
    assert computed_stages(case.refine(out, settings)) == []
    assert not (out / "stages/splat").exists() or not list((out / "stages/splat").iterdir())


def test_settings_are_checked() -> None:
    refused("splat needs bearing or reprojection", load_config, None, ['factors=["splat"]'])
    refused("16", load_config, None, ["splat.sizes=[8]"])
