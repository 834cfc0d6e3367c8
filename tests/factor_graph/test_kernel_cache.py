"""Compiled kernels on disk: what renews them, who shares them, and folders that cannot be used."""

import hashlib
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

PARTS = """
from factors.compiled import kernel_and_part
kernel, part = kernel_and_part()

FACTOR = 2.0

@part
def scaled(x):
    return FACTOR * x
"""
KERNELS = """
from parts import kernel, scaled

@kernel
def twice(x):
    return scaled(x) + 0.0
"""
PROGRAM = """
import sys
import numba.core.event as event
from gsba.log import show_log

class Names(event.Listener):
    def on_start(self, event): names.append(event.data["dispatcher"].__name__)
    def on_end(self, event): pass

names = []
event.register("numba:compile", Names())
show_log()
from kernels import twice
print(twice(3.0), *sorted(names))
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Two files of which one holds a kernel, the other a part and a constant of it."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "parts.py").write_text(PARTS)
    (folder / "kernels.py").write_text(KERNELS)
    return folder


def start(package: Path, cache: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": f"{package}:{root}", "NUMBA_CACHE_DIR": str(cache)}
    environment.pop("NUMBA_DISABLE_JIT", None)
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # an edit within a second must be noticed
    return subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment | variables,
        capture_output=True,
        text=True,
        check=True,
    )


def test_a_kernel_is_renewed_when_what_it_uses_changes(package: Path, tmp_path: Path) -> None:
    """Also in another file, but not for a comment, a moved line or another installation."""
    cache = tmp_path / "cache"
    assert start(package, cache).stdout.split() == ["6.0", "scaled", "twice"]

    (package / "parts.py").write_text("# A comment.\n" + PARTS)
    elsewhere = package.rename(tmp_path / "elsewhere")
    assert start(elsewhere, cache).stdout.split() == ["6.0"]

    (elsewhere / "parts.py").write_text(PARTS.replace("FACTOR = 2.0", "FACTOR = 5.0"))
    assert start(elsewhere, cache).stdout.split() == ["15.0", "scaled", "twice"]
    (elsewhere / "parts.py").write_text(PARTS.replace("FACTOR * x", "FACTOR * x * x"))
    assert start(elsewhere, cache).stdout.split() == ["18.0", "scaled", "twice"]
    options = PARTS.replace("kernel_and_part()", 'kernel_and_part(fastmath={"nsz", "arcp"})')
    (elsewhere / "parts.py").write_text(options)
    for seed in "01":  # sets of options in any order are the same options
        told = start(elsewhere, cache, PYTHONHASHSEED=seed).stdout.split()
        assert told == (["6.0", "scaled", "twice"] if seed == "0" else ["6.0"])

    (elsewhere / "parts.py").write_text(PARTS)
    assert start(elsewhere, cache).stdout.split() == ["6.0"]  # older kernels were kept


def test_a_kernel_is_renewed_when_a_record_that_it_takes_moves(
    package: Path, tmp_path: Path
) -> None:
    """Its file names the module of the record's type, which is no more there."""
    record = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    x: float\n"
    kernel = "@kernel\ndef first(pair):\n    return pair.x + 0.0\n"
    call = "def twice(x):\n    return first(Pair(2 * x))\n"
    for home in ("one", "two"):
        (package / "one.py").unlink(missing_ok=True)
        (package / f"{home}.py").write_text(record)
        text = f"from parts import kernel\nfrom {home} import Pair\n{kernel}{call}"
        (package / "kernels.py").write_text(text)
        assert start(package, tmp_path / "cache").stdout.split() == ["6.0", "first"]


def test_kernels_for_another_processor_are_kept_apart(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    for processor in ("generic", "x86-64-v2" if platform.machine() == "x86_64" else "cortex-a57"):
        told = start(package, cache, NUMBA_CPU_NAME=processor, NUMBA_CPU_FEATURES="")
        assert told.stdout.split() == ["6.0", "scaled", "twice"]
    assert len(list((cache / "gsba").iterdir())) == 2


def test_a_damaged_kernel_is_compiled_anew(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    start(package, cache)
    (file,) = (cache / "gsba").iterdir()
    content = file.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    moved = b"cno_such_module\nRecord\n."  # pickled: a type of a module of another version
    elsewhere = hashlib.sha256(moved).digest() + moved
    for damaged in (content[:middle], flipped, elsewhere):
        file.write_bytes(damaged)
        told = start(package, cache)
        assert told.stdout.split() == ["6.0", "scaled", "twice"]
        assert told.stderr.count("\n") == 1 and "compiling kernels" in told.stderr
    assert start(package, cache).stdout.split() == ["6.0"]


def test_without_a_folder_each_process_compiles(package: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    folder = str(tmp_path / "file/below")
    told = start(package, Path(folder))
    assert told.stdout.split() == ["6.0", "scaled", "twice"]
    first, second = told.stderr.strip().split("\n")
    assert "compiled kernels cannot be kept in" in first and folder in first
    assert "compiling kernels" in second


def test_processes_at_once_compile_a_kernel_once(package: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        runs = list(pool.map(lambda _: start(package, tmp_path / "cache"), range(3)))
    assert sorted(run.stdout.split() for run in runs) == [
        ["6.0"],
        ["6.0"],
        ["6.0", "scaled", "twice"],
    ]
    (file,) = (tmp_path / "cache" / "gsba").iterdir()  # no lock, nothing unfinished
    assert file.suffix == ".kernel"
