"""Poses and a splat of their frames in turns: moves that help are taken, others undone."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from tiny_run import NUM_FRAMES, SETTINGS, Case, computed_stages

from gsba import cubemap, graph, splat_refine
from gsba.adjust import Adjustment
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.evaluate import evaluate
from gsba.log import GsbaError
from gsba.splat_refine import SplatResult
from gsba.store import load_stage
from gsba.types import Keypoints, Trajectory


def settings_for(factors: tuple[str, ...] = ("bearing", "splat"), **splat) -> RefineSettings:
    """Small faces, few steps, a held-out frame in four."""
    small = {
        "sizes": (24,),
        "first_steps": 60,
        "steps": 20,
        "moves": 1,
        "held_out_every": 4,
        "min_gain_db": 0.01,
    }
    chosen = {"factors": factors, "splat": {**small, "backend": "cpu", **splat}}
    return RefineSettings.model_validate({**SETTINGS.model_dump(), **chosen})


def spoiled(case: Case, degrees: float, distance: float, noise: float) -> tuple:
    """Frames, keypoints and a solution whose poses are off and whose observations are doubted."""
    solved, keypoints = load_stage(case.out, "aligned2", tuple[Adjustment, Keypoints])
    rng, poses = np.random.default_rng(0), solved.world_T_rigs.copy()
    sigmas = np.repeat([np.deg2rad(degrees), distance], 3)
    for f in range(1, len(poses)):
        poses[f] = gtsam.Pose3(poses[f]).retract(rng.normal(0, sigmas)).matrix()
    start = replace(solved, world_T_rigs=poses, noise=noise * solved.noise)
    return case.result.frames, keypoints, start


def run(case: Case, given: tuple, settings: RefineSettings, **options) -> SplatResult:
    priors = graph.build(case.result.coarse.world_T_rigs, settings.priors)
    rig = cubemap.rig_for(case.result.frames, settings.cubemap)
    return splat_refine.run(*given, priors, rig, settings, 2, **options)


def errors(case: Case, world_T_rigs: np.ndarray):
    return evaluate(Trajectory(case.result.frames.timestamps, world_T_rigs), case.truth)


def test_a_splat_corrects_poses_that_observations_hardly_hold(case: Case) -> None:
    given = spoiled(case, 0.1, 0.003, 50.0)
    settings = settings_for(sizes=(48,), first_steps=80, steps=120, moves=2)
    result = run(case, given, settings)
    assert result.moves[0].accepted and result.moves[0].psnr_moved > result.moves[0].psnr_stayed
    before, after = (
        errors(case, poses) for poses in (given[2].world_T_rigs, result.adjustment.world_T_rigs)
    )
    assert after.ate.rmse < 0.3 * before.ate.rmse
    assert after.rpe_rotation_deg.median < 0.3 * before.rpe_rotation_deg.median
    assert (result.counts[0].kept, result.counts[0].dropped["held out"]) == (6, 2)


def test_a_move_that_observations_contradict_is_undone(case: Case) -> None:
    given = spoiled(case, 0.0, 0.0, 1.0)
    result = run(case, given, settings_for(max_growth=1e-6, min_gain_db=0))
    assert [move.accepted for move in result.moves] == [False]
    np.testing.assert_array_equal(result.adjustment.world_T_rigs, given[2].world_T_rigs)
    assert not result.adjustment.rounds[-1].accepted


def test_few_frames_are_left_as_they_were(case: Case, caplog: pytest.LogCaptureFixture) -> None:
    given = spoiled(case, 0.0, 0.0, 1.0)
    result = run(case, given, settings_for(held_out_every=NUM_FRAMES))
    assert result.adjustment is given[2] and result.moves == ()
    assert "too few" in caplog.text


def test_an_interrupted_refinement_goes_on_to_the_same_result(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, settings = spoiled(case, 0.1, 0.003, 50.0), settings_for(sizes=(24, 32))
    whole = run(case, given, settings)
    real, calls = splat_refine._Turns.turn, []

    def turn(self, before):
        calls.append(before.turns)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(self, before)

    monkeypatch.setattr(splat_refine._Turns, "turn", turn)
    kept = {"checkpoint": tmp_path / "turns.npz", "key": "these"}
    with pytest.raises(KeyboardInterrupt):
        run(case, given, settings, **kept)
    again = run(case, given, settings, **kept)
    assert calls == [-1, 0, -1, -1, 0]  # the training and the move of the first size are kept
    assert again.moves == whole.moves
    np.testing.assert_array_equal(again.adjustment.world_T_rigs, whole.adjustment.world_T_rigs)
    run(case, given, settings, checkpoint=tmp_path / "turns.npz", key="others")
    assert calls[5:] == [-1, 0, -1, 0]


def test_a_run_with_all_families(case: Case, tmp_path: Path) -> None:
    out = case.copy(tmp_path / "run")
    settings = settings_for(("bearing", "photometric", "splat"))
    few = settings.photometric.model_copy(update={"spacing_deg": 20.0, "depth_levels": 0})
    settings = settings.model_copy(update={"photometric": few})
    result = case.refine(out, settings)
    assert computed_stages(result)[:2] == ["photometric", "splat"]
    (move,) = result.report["splat"]
    assert move["size"] == 24 and move["psnr_stayed"] > 12
    costs = result.report["solver"][-1]["rounds"][-1]["iterations"][0]["costs"]
    assert set(costs) == {"graph", "bearing", "photometric", "splat"}
    stage = next(s for s in result.report["stages"] if s["name"] == "splat")
    assert stage["counts"][0]["dropped"] == {"held out": 2, "unrefined": 0}
    assert case.errors(out).ate.rmse < 1.2 * case.errors().ate.rmse
    assert computed_stages(case.refine(out, settings)) == []
    assert not (out / "stages/splat").exists() or not list((out / "stages/splat").iterdir())


def test_settings_are_checked() -> None:
    with pytest.raises(GsbaError, match="splat starts from bearing or reprojection"):
        load_config(None, ['factors=["splat"]'])
    with pytest.raises(GsbaError, match="16"):
        load_config(None, ["splat.sizes=[8]"])
