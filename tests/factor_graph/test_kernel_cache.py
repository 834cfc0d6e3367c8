"""Compiled kernels on disk: what renews them, who shares them, and folders that cannot be used."""

import hashlib
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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
for package in sys.argv[1:]:
    sys.path.insert(0, package)
    from kernels import twice
    print(twice(3.0), *sorted(names))
    names.clear()
    sys.path.remove(package)
    for name in ("kernels", "parts", "one", "two"):
        sys.modules.pop(name, None)
"""
COMPILED, KEPT = "6.0 scaled twice", "6.0"


def write_package(folder: Path, parts: str = PARTS, kernels: str = KERNELS, **more: str) -> Path:
    """Files of which one holds a kernel, another a part and a constant of it."""
    folder.mkdir()
    for name, text in {"parts": parts, "kernels": kernels, **more}.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def start(cache: Path, *packages: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """A process that imports one package after the other: for each it prints a kernel's result and
    what it compiles."""
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": root, "NUMBA_CACHE_DIR": str(cache)}
    environment.pop("NUMBA_DISABLE_JIT", None)
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *packages],
        env=environment | variables,
        capture_output=True,
        text=True,
        check=True,
    )


def test_a_kernel_is_renewed_when_what_it_uses_changes(tmp_path: Path) -> None:
    """Also in another file, but not for a comment, a moved line or another installation.

    Compilation is announced once per machine."""
    options = PARTS.replace("kernel_and_part()", 'kernel_and_part(fastmath={"nsz", "arcp"})')
    expected = {
        PARTS: COMPILED,
        "# A comment.\n" + PARTS: KEPT,
        PARTS.replace("FACTOR = 2.0", "FACTOR = 5.0"): "15.0 scaled twice",
        PARTS.replace("FACTOR * x", "FACTOR * x * x"): "18.0 scaled twice",
        options: COMPILED,
        PARTS + "\n": KEPT,  # older kernels are there still
    }
    packages = [write_package(tmp_path / str(n), parts) for n, parts in enumerate(expected)]
    first = start(tmp_path / "cache", *packages, PYTHONHASHSEED="0")
    assert first.stdout.splitlines() == list(expected.values())
    assert first.stderr.count("compiling kernels, once per machine") == 1
    # sets of options in any order are the same options
    second = start(tmp_path / "cache", *packages, PYTHONHASHSEED="1")
    assert second.stdout.split() == [line.split()[0] for line in expected.values()]
    assert second.stderr == ""


def test_a_kernel_is_renewed_when_a_record_that_it_takes_moves(tmp_path: Path) -> None:
    """Its file names the module of the record's type, which is no more there."""
    record = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    x: float\n"
    kernel = "@kernel\ndef first(pair):\n    return pair.x + 0.0\n"
    call = "def twice(x):\n    return first(Pair(2 * x))\n"
    packages = []
    for home in ("one", "two"):
        text = f"from parts import kernel\nfrom {home} import Pair\n{kernel}{call}"
        packages.append(write_package(tmp_path / home, kernels=text, **{home: record}))
    told = start(tmp_path / "cache", *packages)
    assert told.stdout.splitlines() == ["6.0 first", "6.0 first"]
    assert len(list((tmp_path / "cache/gsba").iterdir())) == 2


def test_kernels_for_another_processor_are_kept_apart(tmp_path: Path) -> None:
    cache, package = tmp_path / "cache", write_package(tmp_path / "package")
    for processor in ("generic", "x86-64-v2" if platform.machine() == "x86_64" else "cortex-a57"):
        told = start(cache, package, NUMBA_CPU_NAME=processor, NUMBA_CPU_FEATURES="")
        assert told.stdout.splitlines() == [COMPILED]
    assert len(list((cache / "gsba").iterdir())) == 2


def test_a_damaged_kernel_is_compiled_anew(tmp_path: Path) -> None:
    cache, whole = tmp_path / "cache", write_package(tmp_path / "whole")
    start(cache, whole)
    (file,) = (cache / "gsba").iterdir()
    content = file.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    moved = b"cno_such_module\nRecord\n."  # pickled: a type of a module of another version
    elsewhere = hashlib.sha256(moved).digest() + moved
    packages = []
    for n, damaged in enumerate((content[:middle], flipped, elsewhere)):
        (tmp_path / str(n)).write_bytes(damaged)
        damage = f"import shutil\nshutil.copy({str(tmp_path / str(n))!r}, {str(file)!r})\n"
        packages.append(write_package(tmp_path / f"damaging {n}", kernels=damage + KERNELS))
    told = start(cache, *packages, whole)
    assert told.stdout.splitlines() == [COMPILED] * 3 + [KEPT]
    assert told.stderr.count("\n") == 1 and "compiling kernels" in told.stderr


def test_without_a_folder_each_process_compiles(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    folder = tmp_path / "file/below"
    told = start(folder, write_package(tmp_path / "package"))
    assert told.stdout.splitlines() == [COMPILED]
    first, second = told.stderr.strip().split("\n")
    assert "compiled kernels cannot be kept in" in first and str(folder) in first
    assert "compiling kernels" in second


def test_processes_at_once_compile_a_kernel_once(tmp_path: Path) -> None:
    package = write_package(tmp_path / "package")
    with ThreadPoolExecutor(3) as pool:
        runs = list(pool.map(lambda _: start(tmp_path / "cache", package), range(3)))
    assert sorted(run.stdout.strip() for run in runs) == [KEPT, KEPT, COMPILED]
    (file,) = (tmp_path / "cache" / "gsba").iterdir()  # no lock, nothing unfinished
    assert file.suffix == ".kernel"
