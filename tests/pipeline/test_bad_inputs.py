"""Input that cannot be used, through the command line: one line, exit 1, nothing left behind."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run_gsba

NUM_FRAMES = 6


@pytest.fixture
def inputs(tmp_path: Path) -> Path:
    """A folder with `frames`, `slam.tum` and `mask.png` that are as they should be."""
    rng = np.random.default_rng(0)
    (tmp_path / "frames").mkdir()
    for f in range(NUM_FRAMES):
        _write(tmp_path / f"frames/{f}.png", rng.integers(0, 256, (32, 64, 3), np.uint8))
    _write(tmp_path / "mask.png", np.full((32, 64), 255, np.uint8))
    _trajectory(tmp_path, [f"{f} {f} 0 0 0 0 0 1" for f in range(NUM_FRAMES)])
    return tmp_path


def _write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def _trajectory(folder: Path, lines: list[str]) -> None:
    (folder / "slam.tum").write_text("\n".join(lines) + "\n")


def _replace_line(number: int, line: str) -> Callable[[Path], None]:
    """Put `line` where line `number` of the trajectory was, counted from one."""

    def change(folder: Path) -> None:
        lines = (folder / "slam.tum").read_text().splitlines()
        lines[number - 1] = line
        _trajectory(folder, lines)

    return change


def _empty(folder: Path) -> None:
    for path in (folder / "frames").iterdir():
        path.unlink()


def _two_frames(folder: Path) -> None:
    for f in range(2, NUM_FRAMES):
        (folder / f"frames/{f}.png").unlink()


def _truncated(folder: Path) -> None:
    path = folder / "frames/2.png"
    path.write_bytes(path.read_bytes()[:-300])


def _resized(height: int, width: int) -> Callable[[Path], None]:
    return lambda folder: _write(folder / "frames/2.png", np.zeros((height, width, 3), np.uint8))


def _small_mask(folder: Path) -> None:
    _write(folder / "mask.png", np.full((16, 32), 255, np.uint8))


def _mask_of_another_shape(folder: Path) -> None:
    _write(folder / "mask.png", np.full((64, 64), 255, np.uint8))


def _other_clock(folder: Path) -> None:
    _trajectory(folder, [f"{1000 + 7 * f} {f} 0 0 0 0 0 1" for f in range(NUM_FRAMES)])


BAD: dict[str, tuple[Callable[[Path], None], tuple[str, ...]]] = {
    "no frames folder": (lambda folder: (folder / "frames").rename(folder / "x"), ("no such",)),
    "empty folder": (_empty, ("frames", "no JPEG, PNG, WebP or TIFF")),
    "two frames": (_two_frames, ("2 frames", "3")),
    "not an image": (
        lambda folder: (folder / "frames/2.png").write_text("hello") and None,
        ("2.png", "not a JPEG, PNG"),
    ),
    "truncated image": (_truncated, ("2.png", "truncated")),
    "not 2:1": (_resized(32, 32), ("2.png", "32x32")),
    "another size": (_resized(16, 32), ("2.png", "32x16", "64x32")),
    "no trajectory": (lambda folder: (folder / "slam.tum").unlink(), ("slam.tum",)),
    "empty trajectory": (lambda folder: _trajectory(folder, []), ("slam.tum",)),
    "malformed line": (_replace_line(4, "3 1 2"), ("slam.tum:4",)),
    "words": (_replace_line(4, "3 a 0 0 0 0 0 1"), ("slam.tum:4",)),
    "long quaternion": (_replace_line(4, "3 3 0 0 0 0 0 1.1"), ("slam.tum:4", "quaternion")),
    "duplicate time": (_replace_line(4, "2 3 0 0 0 0 0 1"), ("slam.tum:4",)),
    "unsorted times": (_replace_line(4, "1.5 3 0 0 0 0 0 1"), ("slam.tum:4",)),
    "no overlap in time": (_other_clock, ("overlap",)),
    "small mask": (_small_mask, ("mask.png", "32x16", "64x32")),
    "square mask": (_mask_of_another_shape, ("mask.png", "64x64")),
}
OPTIONS = {
    "unknown key": (["--set", "solver.num_thread=5"], ("num_thread",)),
    "out of range": (["--set", "features.max_per_face=1"], ("max_per_face", "16")),
    "wrong kind": (["--set", "solver.num_threads=many"], ("num_threads", "integer")),
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
    assert result.exit_code == 1 and "choose another --out" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert before == {path: path.read_bytes() for path in out.rglob("*")}
