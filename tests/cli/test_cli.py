"""The command line: what it answers, how fast it may not think, and how it fails."""

import errno
import gc
import io
import json
import logging
import os
import re
import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer.main
from command import fails, run_gsba, succeed

import gsba
from gsba import log
from gsba.cli import app
from gsba.cli.app import _DEFAULT_MEMORY_SETTING, _MEMORY_SETTINGS, loading
from gsba.cli.options import OPTIONS
from gsba.config import RefineSettings
from gsba.config_file import allowed_settings, load_config
from gsba.export import ExportFormat
from gsba.log import GsbaError
from gsba.pipeline.recordings import Recording


@pytest.fixture
def pipeline(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Replace the pipeline by one that raises."""

    def install(error: BaseException) -> None:
        def fail(*_: object, **__: object) -> None:
            raise error

        finished = ("load_run", "map_digest")
        for home, names in (("gsba.pipeline", ("refine",)), ("gsba.store.finished", finished)):
            stub = types.ModuleType(home)
            for name in names:
                setattr(stub, name, fail)
            monkeypatch.setitem(sys.modules, home, stub)
        monkeypatch.setattr(gsba, "pipeline", sys.modules["gsba.pipeline"], raising=False)

    return install


def _tum(path: Path, num: int = 5, scale: float = 1.0) -> Path:
    angles = np.linspace(0, 1, num)
    rows = [[t, scale * np.sin(t), 0, scale * np.cos(t), 0, 0, 0, 1] for t in angles]
    np.savetxt(path, rows)
    return path


def test_each_entry_of_the_table_of_options_is_of_a_command() -> None:
    used = set[str]()
    for command in app.registered_commands:
        assert command.callback is not None
        own = {name: f"{command.name}.{name}" for name in command.callback.__annotations__}
        used |= {one if one in OPTIONS else name for name, one in own.items()}
    assert used == OPTIONS.keys()


def test_help_names_every_command_and_format() -> None:
    out = run_gsba("--help").stdout
    for command in ("refine", "export", "evaluate", "demo", "show-config", "--version"):
        assert command in out
    out = run_gsba("export", "--help").stdout
    assert all(to in out for to in ExportFormat)
    for command in typer.main.get_command(app).commands:  # type: ignore[attr-defined]
        assert "[Path]" not in run_gsba(command, "--help").stdout  # nothing of Python


def test_version() -> None:
    assert run_gsba("--version").stdout == f"gsba {gsba.__version__}\n"


def test_show_config_prints_what_load_config_reads(tmp_path: Path) -> None:
    result = succeed("show-config", "--set", "features.max_per_face=77")
    (tmp_path / "all.toml").write_text(result.stdout)
    assert load_config(tmp_path / "all.toml").features.max_per_face == 77
    again = run_gsba("show-config", "--config", tmp_path / "all.toml")
    assert again.stdout == result.stdout


def test_wrong_settings_name_the_key() -> None:
    fails(run_gsba("show-config", "--set", "features.max_per_fce=1"), "did you mean max_per_face?")
    fails(run_gsba("show-config", "--set", "seed=x"), "use an integer")
    fails(run_gsba("show-config", "--set", "seed=-1"), "use an integer >= 0")
    fails(run_gsba("show-config", "--set", "seed=" + "9" * 9999), "seed=999")
    fails(run_gsba("show-config", "--set", "seed=" + "[" * 3000), "the value is not valid TOML")
    fails(run_gsba("show-config", "--set", 'placement.gps="a\\u0000"'), "placement.gps = ")
    fails(run_gsba("show-config", "--set", "video.width=99999"), "use an even integer >= 64")
    wrong = "camera.lens_yaws_deg=[0, 10]"
    fails(run_gsba("show-config", "--set", wrong), "settings camera: lens_yaws_deg: give")
    fails(run_gsba("show-config", "--config", "nowhere.toml"), "cannot read settings nowhere.toml")
    fails(run_gsba("refine", "a", "b", "--out", "c", "--set", "x=1"), "unknown setting x")
    assert not Path("c").exists()


def test_circles_of_recordings_that_are_added(monkeypatch: pytest.MonkeyPatch) -> None:
    def added(run: Path, recordings: list[Recording], *_: object, **__: object) -> None:
        raise GsbaError(f"circles of {recordings[0].frames}: {recordings[0].circles}")

    monkeypatch.setattr("gsba.pipeline.add_recordings", added)
    monkeypatch.setattr("gsba.cli.growing._refuse_changed", lambda runs: None)
    fails(
        run_gsba("add", "run", "raw", "--circle", "72,71,70"),
        "circles of raw: [(72.0, 71.0, 70.0)]",
    )


def test_factors_are_a_setting() -> None:
    if "factors" not in RefineSettings.model_fields:
        pytest.skip("no factor families to choose from")
    out = run_gsba("show-config", "--factors", "bearing,reprojection").stdout
    assert 'factors = ["bearing", "reprojection"]' in out
    fails(run_gsba("show-config", "--factors", "nonsense"), '"bearing"')
    fails(run_gsba("show-config", "--factors", "splat"), "error: factors: splat needs bearing")


@pytest.mark.parametrize(
    ("error", "message", "code"),
    [
        (GsbaError("frames: no such folder"), "error: frames: no such folder", 1),
        (KeyboardInterrupt(), "error: interrupted; run again to resume", 130),
        (PermissionError(errno.EACCES, "Permission denied", "out"), "out: Permission denied", 1),
        (OSError(errno.ENOSPC, "No space left on device"), "No space left on device", 1),
        (MemoryError(), "out of memory", 1),
    ],
)
def test_expected_failures_are_one_line(
    pipeline: Callable[[BaseException], None], error: BaseException, message: str, code: int
) -> None:
    pipeline(error)
    fails(run_gsba("refine", "frames", "slam.tum", "--out", "run"), message, code)
    fails(run_gsba("export", "run", "--to", "colmap"), message, code)


def test_what_begins_anew_is_not_said_to_resume(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("gsba.demo.make_walk", stopped)
    fails(run_gsba("demo"), "error: interrupted; begins anew when it is run again", 130)


def test_what_nobody_foresaw_is_one_line_that_can_be_reported(
    pipeline: Callable[[BaseException], None],
) -> None:
    pipeline(ZeroDivisionError("no\nway"))
    call = ["refine", "frames", "slam.tum", "--out", "run"]
    fails(run_gsba(*call), "unforeseen ZeroDivisionError at refining.py:")
    fails(run_gsba(*call), "(no way): a bug in gsba")
    assert isinstance(run_gsba("--debug", *call).exception, ZeroDivisionError)


def test_memory_errors_name_the_stage_and_its_settings(
    pipeline: Callable[[BaseException], None],
) -> None:
    error = MemoryError("Unable to allocate 4.50 GiB")
    pipeline(error)
    fails(run_gsba("export", "run", "--to", "ply"), "(Unable to allocate 4.50 GiB): give smaller")
    error.add_note("align1")
    fails(run_gsba("export", "run", "--to", "ply"), "(stage align1; Unable")
    fails(run_gsba("export", "run", "--to", "ply"), "lower patches.max_width or solver.num_threads")


def test_settings_that_memory_errors_name_exist() -> None:
    known = {name for name, _, _ in allowed_settings(RefineSettings())}
    advice = " ".join([*_MEMORY_SETTINGS.values(), _DEFAULT_MEMORY_SETTING])
    assert set(re.findall(r"\w+\.\w+", advice)) <= known


def test_messages_are_short_and_printable(pipeline: Callable[[BaseException], None]) -> None:
    pipeline(GsbaError("9" * 10_000 + "\udcff\nend"))
    line = run_gsba("refine", "frames", "slam.tum", "--out", "run").stderr
    assert len(line) < 1100 and line.startswith("error: 999") and line.endswith("end\n")
    assert "\\udcff" in line


def test_export_checks_its_options(tmp_path: Path) -> None:
    fails(run_gsba("export", tmp_path, "--to", "obj"), "use one of colmap, colmap-flat, colmap-erp")
    for size in (0, 15):
        result = run_gsba("export", tmp_path, "--to", "ply", "--face-size", size)
        fails(result, f"export.face_size = {size} is not allowed: use an integer >= 16")
    fails(run_gsba("export", tmp_path, "--to", "ply", "--gps", ""), 'gps = "" is not allowed')


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("export", "run", "--to", "tum", "--baseline", 32), "--baseline is for --scale lens"),
        (("export", "run", "--to", "tum", "--gps-sigma", 1), "give --gps FILE as well"),
        (("export", "run", "--to", "tum", "--gps-offset", 0), "give --gps FILE as well"),
        (("mask", "run", "--out", "run/"), "is the folder of the frames: choose another"),
        (("evaluate", "run", "--truth", "t", "--against", "b"), "give --splat as well"),
        (("evaluate", "run", "--truth", "t", "--iterations", 9), "give --splat as well"),
        (("evaluate", "run", "--scan", "s", "--depth", "d"), "give --truth FILE as well"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    arguments: tuple[object, ...], message: str
) -> None:
    fails(run_gsba(*arguments), message)


def test_evaluate_compares_a_file_or_a_run(tmp_path: Path) -> None:
    truth = _tum(tmp_path / "truth.tum")
    (tmp_path / "run").mkdir()
    _tum(tmp_path / "run/trajectory.tum", scale=3.0)
    numbers = tmp_path / "numbers.json"
    result = succeed("evaluate", tmp_path / "run", "--truth", truth, "--json", numbers)
    assert "5/5" in result.stdout
    assert "covariances cannot be checked" in result.stdout
    assert json.loads(numbers.read_text())["scale"] == pytest.approx(1 / 3)
    assert run_gsba("evaluate", truth, "--truth", truth).exit_code == 0


def test_evaluate_fails_in_one_line(tmp_path: Path) -> None:
    truth = _tum(tmp_path / "truth.tum")
    fails(run_gsba("evaluate", tmp_path / "none.tum", "--truth", truth), "none.tum")
    fails(run_gsba("evaluate", tmp_path, "--truth", truth), "trajectory.tum")
    (tmp_path / "bad.tum").write_text("0 1 2 nan 0 0 0 1\n")
    fails(run_gsba("evaluate", truth, "--truth", tmp_path / "bad.tum"), "bad.tum:1")


def test_demo_checks_its_options(tmp_path: Path) -> None:
    fails(run_gsba("demo", "--path", "spiral", "--out", tmp_path), "'spiral'")
    fails(run_gsba("demo", "--frames", 2, "--out", tmp_path), "2 frames")
    fails(run_gsba("demo", "--seed", -1, "--out", tmp_path), "seed -1")
    assert list(tmp_path.iterdir()) == []


def test_script_ends_quietly_in_a_closed_pipe() -> None:
    script = "from gsba.cli import main; main()"
    path = str(Path(gsba.__file__).parents[1])
    command = [sys.executable, "-c", script, "show-config"]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        command, stdout=writer, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": path}
    )
    os.close(writer)
    assert done.stderr == b""


@pytest.mark.parametrize(("level", "shown"), [(logging.WARNING, False), (logging.INFO, True)])
def test_a_quiet_run_shows_no_bars(
    monkeypatch: pytest.MonkeyPatch, level: int, shown: bool
) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", terminal)
    log._console.cache_clear()
    logger = logging.getLogger("gsba")
    monkeypatch.setattr(logger, "level", logger.level)
    logger.setLevel(level)
    try:
        assert list(log.track(range(3), "counting")) == [0, 1, 2]
    finally:
        log._console.cache_clear()
    assert ("counting" in terminal.getvalue()) is shown


def test_garbage_is_collected_again_after_loading() -> None:
    with pytest.raises(ImportError), loading():
        assert not gc.isenabled()
        raise ImportError
    assert gc.isenabled()


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[object, ...]]:
    """Frames, trajectory and folder of every call of `refine`, in place of a run."""
    calls: list[tuple[object, ...]] = []

    def record(*given: object, **_: object) -> None:
        calls.append(given[:3])
        raise GsbaError("recorded")

    stub = types.ModuleType("gsba.pipeline")
    setattr(stub, "refine", record)  # noqa: B010
    monkeypatch.setitem(sys.modules, "gsba.pipeline", stub)
    monkeypatch.setattr(gsba, "pipeline", stub, raising=False)
    monkeypatch.chdir(tmp_path)
    return calls


def test_refine_needs_no_more_than_a_folder_or_a_video(
    runs: list[tuple[object, ...]], tmp_path: Path
) -> None:
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips/walk.mp4").touch()
    (tmp_path / "clips/walk").touch()
    (tmp_path / "bare").touch()
    for frames in ("frames", ".", "clips/walk.mp4", "clips/walk", "bare"):
        run_gsba("refine", frames)
    folders = ["frames-run", f"{tmp_path.name}-run", "walk", "walk", "bare-run"]
    assert [(trajectory, str(out)) for _, trajectory, out in runs] == [(None, f) for f in folders]


def test_a_trajectory_and_none_are_not_both(runs: list[tuple[object, ...]]) -> None:
    fails(run_gsba("refine", "frames", "slam.tum", "--no-trajectory"), "exclude each other")
    fails(run_gsba("refine", "frames", "--keyframes", "k.tum"), "--keyframes needs the TRAJECTORY")
    assert not runs


@pytest.mark.parametrize("loads", ["", "with loading(): import gsba"])
def test_sigterm_ends_a_command_in_one_line(loads: str) -> None:
    """pycolmap, which other packages import, would print a stack."""
    script = f"""
import os, signal, time
from gsba.cli.app import app, command, loading
@command
def wait() -> None:
    {loads or "pass"}
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)
app(["wait"])
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.returncode == 130
    assert ended.stderr.splitlines() == ["error: interrupted; run again to resume"]
