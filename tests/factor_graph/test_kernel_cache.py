"""Compiled kernels on disk: what renews them, who shares them, and folders that cannot be used."""

import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
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
# Numba is imported once, and each program runs in a fork of the process that has done so.
SERVER = """
import json, os, sys
import factors.compiled, gsba.log, numba.core.event

for line in sys.stdin:
    package, cache, program, *outputs = json.loads(line)
    if process := os.fork():
        print(os.waitpid(process, 0)[1], flush=True)
        continue
    for number, path in enumerate(outputs, 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.path.insert(0, package)
    numba.core.config.CACHE_DIR = cache
    exec(program)
    sys.exit()
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Two files of which one holds a kernel, the other a part and a constant of it."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "parts.py").write_text(PARTS)
    (folder / "kernels.py").write_text(KERNELS)
    return folder


def environment_of(*paths: object) -> dict[str, str]:
    environment = os.environ | {"PYTHONPATH": ":".join(map(str, paths))}
    environment.pop("NUMBA_DISABLE_JIT", None)
    return environment | {"PYTHONDONTWRITEBYTECODE": "1"}  # to notice an edit within a second


def start(package: Path, cache: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own."""
    environment = environment_of(package, ROOT) | {"NUMBA_CACHE_DIR": str(cache)} | variables
    command = [sys.executable, "-c", PROGRAM]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True)


class Forks:
    """Runs the program in forks of a process that has imported Numba."""

    def __init__(self, server: subprocess.Popen[str], folder: Path) -> None:
        self._server, self._outputs = server, (folder / "stdout", folder / "stderr")

    def __call__(self, package: Path, cache: Path) -> subprocess.CompletedProcess[str]:
        assert self._server.stdin and self._server.stdout
        words = map(str, (package, cache, PROGRAM, *self._outputs))
        print(json.dumps(list(words)), file=self._server.stdin, flush=True)
        status = int(self._server.stdout.readline())
        told = subprocess.CompletedProcess([], status, *(p.read_text() for p in self._outputs))
        told.check_returncode()
        return told


@pytest.fixture(scope="module")
def fork(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    with subprocess.Popen(
        [sys.executable, "-c", SERVER],
        env=environment_of(ROOT),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as server:
        yield Forks(server, tmp_path_factory.mktemp("forks"))


def test_a_kernel_is_renewed_when_what_it_uses_changes(
    package: Path, tmp_path: Path, fork: Forks
) -> None:
    """Also in another file, but not for a comment, a moved line or another installation."""
    cache = tmp_path / "cache"
    assert fork(package, cache).stdout.split() == ["6.0", "scaled", "twice"]

    (package / "parts.py").write_text("# A comment.\n" + PARTS)
    elsewhere = package.rename(tmp_path / "elsewhere")
    assert fork(elsewhere, cache).stdout.split() == ["6.0"]

    (elsewhere / "parts.py").write_text(PARTS.replace("FACTOR = 2.0", "FACTOR = 5.0"))
    assert fork(elsewhere, cache).stdout.split() == ["15.0", "scaled", "twice"]
    (elsewhere / "parts.py").write_text(PARTS.replace("FACTOR * x", "FACTOR * x * x"))
    assert fork(elsewhere, cache).stdout.split() == ["18.0", "scaled", "twice"]
    options = PARTS.replace("kernel_and_part()", 'kernel_and_part(fastmath={"nsz", "arcp"})')
    (elsewhere / "parts.py").write_text(options)
    for seed in "01":  # sets of options in any order are the same options
        told = start(elsewhere, cache, PYTHONHASHSEED=seed).stdout.split()
        assert told == (["6.0", "scaled", "twice"] if seed == "0" else ["6.0"])

    (elsewhere / "parts.py").write_text(PARTS)
    assert fork(elsewhere, cache).stdout.split() == ["6.0"]  # older kernels were kept


def test_a_kernel_is_renewed_when_a_record_that_it_takes_moves(
    package: Path, tmp_path: Path, fork: Forks
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
        assert fork(package, tmp_path / "cache").stdout.split() == ["6.0", "first"]


def test_kernels_for_another_processor_are_kept_apart(package: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    for processor in ("generic", "x86-64-v2" if platform.machine() == "x86_64" else "cortex-a57"):
        told = start(package, cache, NUMBA_CPU_NAME=processor, NUMBA_CPU_FEATURES="")
        assert told.stdout.split() == ["6.0", "scaled", "twice"]
    assert len(list((cache / "gsba").iterdir())) == 2


def test_a_damaged_kernel_is_compiled_anew(package: Path, tmp_path: Path, fork: Forks) -> None:
    cache = tmp_path / "cache"
    fork(package, cache)
    (file,) = (cache / "gsba").iterdir()
    content = file.read_bytes()
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    moved = b"cno_such_module\nRecord\n."  # pickled: a type of a module of another version
    elsewhere = hashlib.sha256(moved).digest() + moved
    for damaged in (content[:middle], flipped, b"", elsewhere):
        file.write_bytes(damaged)
        told = fork(package, cache)
        assert told.stdout.split() == ["6.0", "scaled", "twice"]
        assert told.stderr.count("\n") == 1 and "compiling kernels" in told.stderr
    assert fork(package, cache).stdout.split() == ["6.0"]


@pytest.mark.parametrize("folder", ["file/below", "/dev/full/below", "/proc/below"])
def test_without_a_folder_each_process_compiles(
    package: Path, tmp_path: Path, fork: Forks, folder: str
) -> None:
    (tmp_path / "file").write_text("no folder")
    told = fork(package, tmp_path / folder)
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
