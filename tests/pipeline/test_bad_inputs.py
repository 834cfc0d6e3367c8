"""Input that cannot be used, through the command line: one line, exit 1, nothing left behind.

A case of each file and option; what else a file is refused for is tested with its reader.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import fails, run_gsba

NUM_FRAMES = 6
LINES = [f"{f} {f} 0 0 0 0 0 1" for f in range(NUM_FRAMES)]  # of the trajectory


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder with `frames`, `slam.tum` and `mask.png` that are as they should be."""
    rng = np.random.default_rng(0)
    (tmp_path / "frames").mkdir()
    for f in range(NUM_FRAMES):
        _write(tmp_path / f"frames/{f}.png", rng.integers(0, 256, (32, 64, 3), np.uint8))
    _write(tmp_path / "mask.png", np.full((32, 64), 255, np.uint8))
    _trajectory(tmp_path, LINES)
    return tmp_path


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def _trajectory(folder: Path, lines: list[str]) -> None:
    (folder / "slam.tum").write_text("\n".join(lines) + "\n")


def _truncated(folder: Path) -> None:
    path = folder / "frames/2.png"
    path.write_bytes(path.read_bytes()[:-300])


def _small_mask(folder: Path) -> None:
    _write(folder / "mask.png", np.full((16, 32), 255, np.uint8))


def _other_clock(folder: Path) -> None:
    _trajectory(folder, [f"{1000 + 7 * f} {f} 0 0 0 0 0 1" for f in range(NUM_FRAMES)])


BAD: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no frames folder": (lambda folder: (folder / "frames").rename(folder / "x"), ("no such",)),
    "truncated image": (_truncated, ("2.png", "truncated")),
    "no trajectory": (lambda folder: (folder / "slam.tum").unlink(), ("slam.tum",)),
    "malformed line": (
        lambda folder: _trajectory(folder, [*LINES[:3], "3 1 2", *LINES[4:]]),
        ("slam.tum:4",),
    ),
    "no overlap in time": (_other_clock, ("overlap",)),
    "small mask": (_small_mask, ("mask.png", "32x16", "64x32")),
}
OPTIONS = {
    "unknown family": (["--factors", "magic"], ("magic", "bearing")),
    "no settings file": (["--config", "nowhere.toml"], ("nowhere.toml",)),
    "no masks": (["--masks", "nowhere.png"], ("nowhere.png",)),
    "no timestamps": (["--timestamps", "nowhere.csv"], ("nowhere.csv",)),
    "bad fps": (["--fps", "0"], ("fps",)),
}


def _refuse(folder: Path, options: list[str], said: tuple[str, ...]) -> None:
    """The command ends with one line that says all of `said`, and makes no folder."""
    out = folder / "run"
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    command = ["--quiet", "refine", folder / "frames", folder / "slam.tum", "--out", out]
    if "--masks" not in options:
        options = [*options, "--masks", str(folder / "mask.png")]
    if not {"--fps", "--timestamps"} & set(options):
        options = [*options, "--fps", "1"]
    result = run_gsba(*command, *options)
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.exit_code == 1, result.output
    assert errors == result.stderr.splitlines()[-1:] and "Traceback" not in result.output
    assert all(part in errors[0] for part in said), errors
    assert not out.exists()
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused(inputs: Path, name: str) -> None:
    spoil, said = BAD[name]
    spoil(inputs)
    _refuse(inputs, [], said)


@pytest.mark.parametrize("name", OPTIONS)
def test_bad_options_are_refused(inputs: Path, name: str) -> None:
    options, said = OPTIONS[name]
    _refuse(inputs, options, said)


def test_good_files_come_further(inputs: Path) -> None:
    """What the spoiled inputs start from is fine: noise is only refused for matching nothing."""
    out = inputs / "run"
    command = ["--quiet", "refine", inputs / "frames", inputs / "slam.tum", "--out", out]
    command += ["--fps", "1", "--masks", inputs / "mask.png"]
    result = run_gsba(*command)
    assert result.exit_code == 1
    assert "no two neighbouring frames match" in result.stderr
    assert sorted(path.name for path in out.iterdir()) == ["gsba.json", "stages"]


@pytest.mark.parametrize("belongs", ["another run", "somebody"])
def test_folders_of_others_are_left_alone(inputs: Path, belongs: str) -> None:
    out = inputs / "run"
    out.mkdir()
    if belongs == "another run":
        (out / "gsba.json").write_text('{"origin": {"frames": "/elsewhere"}, "wrote": []}')
    else:
        (out / "thesis.txt").write_text("years of work")
    before = {path: path.read_bytes() for path in out.rglob("*")}
    command = ["--quiet", "refine", inputs / "frames", inputs / "slam.tum", "--out", out]
    result = run_gsba(*command, "--fps", "1")
    fails(result, "choose another --out")
    assert before == {path: path.read_bytes() for path in out.rglob("*")}
