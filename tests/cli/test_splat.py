"""`gsba splat`: a run and a dataset in one call."""

import json
from pathlib import Path
from typing import Any

import pytest
from command import fails, run_gsba, succeed
from tiny_run import Case

from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.log import GsbaError
from gsba.pipeline import RunResult


@pytest.mark.parametrize("upright", [True, False])
def test_splat_writes_a_trainers_dataset(
    upright: bool, case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`splat` refines, then exports; a world without a vertical goes out as it is."""
    run, called = case.copy(tmp_path / "run"), []

    def refine(
        frames: Path, trajectory: None, out: Path, settings: RefineSettings, **rest: Any
    ) -> RunResult:
        called.append((frames, trajectory, out, settings, rest))
        return case.result

    def no_vertical(*given: object) -> None:
        raise GsbaError("the frames have no common up axis")

    monkeypatch.setattr("gsba.pipeline.refine", refine)
    if not upright:
        monkeypatch.setattr("gsba.placement.placement.place", no_vertical)
    options = ("--out", run, "--to", "brush", "--config", "fast", "--face-size", 64)
    lenses = "--calibration", tmp_path / "lenses.json", "--circle", "9,8,7"
    options += lenses if upright else ("--fresh",)
    known = {"calibration": tmp_path / "lenses.json", "circles": [(9.0, 8.0, 7.0)]}
    known = known if upright else {"calibration": None, "circles": []}
    known |= {"fresh": not upright}
    done = succeed("splat", tmp_path / "walk.mp4", *options)
    assert called == [(tmp_path / "walk.mp4", None, run, load_config(Path("fast")), known)]
    assert f"brush: brush {run / 'brush'}" in done.output
    assert (run / "brush/sparse/0/images.bin").is_file()
    place = json.loads((run / "brush/transform.json").read_text())
    assert (place["up"] == "-y") == upright, place


def test_splat_refuses_a_wrong_trainer_before_it_refines(tmp_path: Path) -> None:
    done = run_gsba("splat", tmp_path / "walk.mp4", "--to", "brsh")
    assert done.exit_code == 1 and "--to brsh is not known" in done.stderr


def test_splat_refuses_a_renderer_that_is_not_there_before_it_refines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere() -> None:
        raise GsbaError("the gsplat backend needs a CUDA device: use --backend cpu")

    monkeypatch.setattr("gsba.splat.gpu.GsplatBackend", nowhere)
    call = "splat", tmp_path / "walk.mp4", "--backend", "gsplat"
    fails(run_gsba(*call), "the gsplat backend needs a CUDA device")
    fails(run_gsba(*call, "--to", "brush"), "leave out --iterations and --backend")


def test_summaries_of_commands_fit_their_lines() -> None:
    lines = run_gsba("--help").output.splitlines()
    assert not [line for line in lines if line.endswith("...") and "Usage" not in line]
