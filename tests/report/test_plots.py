"""Figures of runs: what they draw, where they are written, and that they never change by chance."""

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import fails, run_gsba, succeed
from PIL import Image
from refusals import refused
from scipy.spatial.transform import Rotation
from tiny_run import Case

from gsba.evaluate import charts
from gsba.evaluate.splats import SourceResult, _write_curves, poses_for
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import pose
from gsba.report.plots import _errors, _residuals, _shares, _trajectories, draw, load
from gsba.similarity import Sim3
from gsba.splat.scores import Score
from gsba.store.finished import load_run
from gsba.trajectory.association import refuse_untimed
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

matplotlib = pytest.importorskip("matplotlib")


def _walk(num: int = 30, noise: float = 0.0) -> Trajectory:
    """Upright poses around a bent path, from second 1000 on."""
    rng = np.random.default_rng(4)
    angles = np.linspace(0, 2.5, num)
    positions = np.stack([4 * np.sin(angles), 0.1 * angles, 3 * np.cos(angles)], axis=1)
    rotations = Rotation.from_rotvec(np.outer(angles, [0, 1, 0])).as_matrix()
    turned = Rotation.from_rotvec(noise * rng.normal(size=(num, 3))).as_matrix()
    poses = pose(rotations @ turned, positions + noise * rng.normal(size=(num, 3)))
    return Trajectory(1000 + 0.5 * np.arange(num), poses)


def _written(path: Path, walk: Trajectory) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_tum(path, walk)
    return path


def _drawn(fill: Callable) -> tuple[list, list[str]]:
    """The panels of a figure, and the names in its legend."""
    from matplotlib.figure import Figure

    figure = Figure()
    fill(figure)
    legend = figure.legends[0] if figure.legends else None
    return figure.axes, [text.get_text() for text in legend.get_texts()] if legend else []


def test_runs_are_laid_on_the_truth_with_the_errors_that_evaluate_has(
    case: Case, tmp_path: Path
) -> None:
    other = _written(tmp_path / "other.tum", read_trajectory(case.slam))
    run, alone = load([case.out, other], case.truth)
    judged = evaluate(run.refined, case.truth)
    assert np.sqrt(np.mean(run.errors.positions**2)) == pytest.approx(judged.ate.rmse)
    assert np.degrees(np.median(run.errors.rotations)) == pytest.approx(judged.rotation_deg.median)
    placed = run.placed.points(run.refined.world_T_rigs[:, :3, 3])
    off = np.linalg.norm(placed - case.truth.world_T_rigs[:, :3, 3], axis=1)
    np.testing.assert_allclose(off, run.errors.positions, atol=1e-12)
    assert run.coarse_errors.positions.mean() > run.errors.positions.mean()
    assert alone.residuals_deg is None and alone.coarse is None and alone.errors is not None
    panels, names = _drawn(lambda figure: _errors(figure, (run, alone)))
    assert names == ["run, before (trajectory file)", "run", "other.tum"]
    before, after, _ = panels[0].get_lines()
    np.testing.assert_array_equal(after.get_ydata(), run.errors.positions)
    np.testing.assert_array_equal(before.get_ydata(), run.coarse_errors.positions)
    assert panels[0].get_yscale() == "log" and after.get_xdata()[0] == 0
    assert "units of the truth" in panels[0].get_ylabel()


def test_frames_without_times_are_not_compared_by_time(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are numbered from 0, as true poses in a file without times are."""
    found, frames = load_run(case.out)
    untimed = replace(frames, timed=False)
    for module in ("gsba.store.finished", "gsba.report.plots"):
        monkeypatch.setattr(f"{module}.load_run", lambda *_: (found, untimed))
    later = Trajectory(case.truth.timestamps + 0.001, case.truth.world_T_rigs)
    message = "the frames have no times to match true poses with"
    refused(message, load, [case.out], later)
    refused(message, poses_for, untimed, later)
    path = _written(tmp_path / "truth.tum", later)
    fails(run_gsba("evaluate", case.out, "--truth", path), message)
    numbered = np.arange(len(case.truth.timestamps), dtype=np.float64)
    refuse_untimed(untimed, Trajectory(numbered, case.truth.world_T_rigs))


def test_residuals_are_those_of_the_report(case: Case) -> None:
    (run,) = load([case.out])
    (left, right), names = _drawn(lambda figure: _residuals(figure, (run,)))
    assert names == ["run"]
    table = np.genfromtxt(case.out / "poses.csv", delimiter=",", names=True, dtype=None)
    told = table["median_residual_deg"]
    np.testing.assert_allclose(left.get_lines()[0].get_ydata(), told, rtol=1e-3)
    x, y = right.get_lines()[0].get_data()
    assert np.all(np.diff(x) >= 0) and y[-1] == 1
    assert run.residuals_deg is not None
    assert x[np.searchsorted(y, 0.5)] == pytest.approx(np.median(run.residuals_deg), rel=0.02)


def test_without_truth_runs_are_laid_on_the_first_of_them(tmp_path: Path) -> None:
    walk = _walk()
    change = Sim3(3.0, Rotation.from_rotvec([0.4, 1.0, -2.0]).as_matrix(), np.array([5.0, -7, 2]))
    moved = Trajectory(walk.timestamps, change.poses(walk.world_T_rigs))
    elsewhere = Trajectory(walk.timestamps + 5000, moved.world_T_rigs)
    paths = [
        _written(tmp_path / f"{name}.tum", one)
        for name, one in (("a", walk), ("b", moved), ("c", elsewhere))
    ]
    shown = load(paths)
    assert shown[1].placed is not None and shown[2].placed is None
    assert shown[1].placed.scale == pytest.approx(1 / 3)
    panels, names = _drawn(lambda figure: _trajectories(figure, shown, None))
    assert names == ["trajectory"]
    assert [axes.get_title() for axes in panels] == ["a.tum", "b.tum", "c.tum"]
    first, second, third = (axes.get_lines()[0].get_xydata() for axes in panels)
    np.testing.assert_allclose(first, second, atol=1e-6)
    assert np.ptp(third, axis=0).max() == pytest.approx(3 * np.ptp(first, axis=0).max(), rel=0.01)
    assert panels[1].get_xlabel() == "units of a.tum" and panels[2].get_xlabel() == "own units"
    assert panels[0].get_aspect() == 1


def test_a_walk_is_seen_from_above(tmp_path: Path) -> None:
    """Lengths in the level plane are kept; what goes up is not seen."""
    walk = _walk()
    shown = load([_written(tmp_path / "a.tum", walk)], walk)
    panels, names = _drawn(lambda figure: _trajectories(figure, shown, walk))
    assert names == ["trajectory", "truth"]
    level = walk.world_T_rigs[:, [0, 2], 3]
    line = panels[0].get_lines()[0].get_xydata()
    wanted = np.linalg.norm(np.diff(level, axis=0), axis=1)
    np.testing.assert_allclose(np.linalg.norm(np.diff(line, axis=0), axis=1), wanted, atol=1e-6)


def test_figures_are_the_same_each_time_whatever_the_users_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = _walk()
    paths = [_written(tmp_path / f"{k}.tum", _walk(noise=0.01 * k)) for k in (1, 2)]
    first = draw(load(paths, walk), tmp_path / "one", walk)
    assert [path.name for path in first] == [
        *("trajectories.png", "trajectories.svg", "errors.png", "errors.svg")
    ]
    monkeypatch.setitem(matplotlib.rcParams, "font.size", 30.0)
    monkeypatch.setitem(matplotlib.rcParams, "axes.facecolor", "red")
    second = draw(load(paths, walk), tmp_path / "two", walk)
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert matplotlib.rcParams["font.size"] == 30.0
    assert len(list((tmp_path / "one").iterdir())) == 4  # nothing half-written beside
    for path in first[::2]:
        with Image.open(path) as image:
            assert image.format == "PNG" and min(image.size) > 500
    text = first[1].read_text()
    assert "<svg" in text and not re.search(r"dc:date|20\d\d-\d\d", text)


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_one_file_holds_all_figures(case: Case, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"paper.{suffix}"
    shown = load([case.out], case.truth)
    assert draw(shown, out, case.truth) == [out]
    drawn = out.read_bytes()
    assert drawn.startswith({"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix])
    assert b"CreationDate" not in drawn  # of a PDF; the others are drawn twice above


def test_names_are_shown_as_they_are(tmp_path: Path) -> None:
    walk = _walk()
    paths = [_written(tmp_path / name, walk) for name in ("a/_x$1$.tum", "b/_x$1$.tum")]
    shown = load(paths)
    assert [one.name for one in shown] == ["a/_x$1$.tum", "b/_x$1$.tum"]
    out = tmp_path / "a.svg"
    charts.write(
        [out], (2, 2), lambda figure: figure.subplots().set_title(charts.plain("_x$1$")) and None
    )
    assert "_x$1$" in out.read_text()  # as a comment beside the glyphs
    refused("is given twice", load, [paths[0], tmp_path / "b" / ".." / "a" / "_x$1$.tum"])


def test_shares_of_many_values_keep_their_ends() -> None:
    values = np.random.default_rng(0).exponential(size=12345)
    x, y = _shares(values)
    assert len(x) <= 2000 and x[0] == values.min() and (x[-1], y[-1]) == (values.max(), 1)
    assert y[0] == pytest.approx(1 / 12345)
    np.testing.assert_allclose(y, np.searchsorted(np.sort(values), x, side="right") / 12345)


def test_the_command_says_what_it_wrote_or_why_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    walk = _written(tmp_path / "a.tum", _walk())

    def call(*arguments: object):
        return run_gsba("plot", *arguments)

    done = succeed("plot", walk, "--out", tmp_path / "figures", "--truth", walk)
    assert len(done.stdout.splitlines()) == 4
    later = Trajectory(_walk().timestamps + 99, _walk().world_T_rigs)
    late = _written(tmp_path / "late.tum", later)
    for arguments, message in (
        ((walk, "--out", tmp_path / "a.jpg"), "give a .png, .svg or .pdf file, or a folder"),
        ((tmp_path, "--out", tmp_path / "x"), str(tmp_path)),
        ((walk, late, "--out", tmp_path / "x", "--truth", walk), "late.tum: only 0 of 30 true"),
    ):
        fails(call(*arguments), message)
        assert not (tmp_path / "x").exists()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    fails(call(walk, "--out", tmp_path / "x"), "pip install 'gsba[plot]'")


def _source(psnr: list[float]) -> SourceResult:
    scores = [Score(value, value, 0.9, None) for value in psnr]
    curve = {100 * (k + 1): score for k, score in enumerate(scores)}
    return SourceResult({"a": scores[-1]}, scores[-1], curve, 10)


def test_curves_of_trainings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    results = {"refined": _source([20.0, 25, 26]), "slam": _source([18.0, 21, 22])}
    _write_curves(tmp_path, results)
    with Image.open(tmp_path / "curves.png") as image:
        assert image.width > 800
    drawn = (tmp_path / "curves.svg").read_text()
    for text in ("PSNR of held-out frames, dB", "training steps", "refined", "slam"):
        assert f"<!-- {text} -->" in drawn
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with caplog.at_level("INFO"):
        _write_curves(tmp_path / "none", results)
    assert "curves are not plotted: figures need matplotlib" in caplog.text
    assert not (tmp_path / "none").exists()
