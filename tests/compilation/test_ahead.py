"""Kernels compiled ahead: the recorded signatures are those of real runs, processes end."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from factors.compiled import Kernel
from gsba.compilation import signatures

CALLED = """
import gc, json, sys
from factors.compiled import Kernel
from gsba.cli import main
try:
    main()
finally:
    kernels = [each for each in gc.get_objects() if isinstance(each, Kernel)]
    rows = [
        [f"{each.py_func.__module__}.{each.py_func.__qualname__}", list(map(str, types))]
        for each in kernels for types in each.overloads
    ]
    print(json.dumps(rows))
"""
PARENT = """
import os, sys, time
from gsba.compilation import ahead
processes, start = [], ahead.subprocess.Popen
def spied(*args, **options):
    processes.append(start(*args, **options))
    return processes[-1]
ahead.subprocess.Popen = spied
for kinds in (["demo", "refine"], ["refine"], ["demo"]):
    ahead.compile_ahead(*kinds)
    print(len(processes))
print(*(each.pid for each in processes))
sys.stdout.flush()
os._exit(1)
"""


def run(program: str, *arguments: str, **variables: str) -> str:
    command = [sys.executable, "-c", program, *arguments]
    environment = os.environ | variables
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return done.stdout


@pytest.mark.parametrize("kind", signatures.KINDS)
def test_recorded_kernels_exist(kind: str) -> None:
    recorded = signatures.read(kind)
    assert recorded and [name for name, _ in recorded] == signatures.names(kind)
    for name, types in recorded:
        kernel = signatures.find(name)
        assert isinstance(kernel, Kernel)
        assert len(kernel.py_func.__code__.co_varnames) >= len(types)


def test_writing_signatures_gives_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = {kind: signatures.read(kind) for kind in signatures.KINDS}
    before = signatures.FILE.read_text()
    monkeypatch.setattr(signatures, "FILE", tmp_path / "signatures.json")
    signatures.write(recorded)
    assert (tmp_path / "signatures.json").read_text() == before


def test_a_first_run_calls_only_recorded_kernels(tmp_path: Path) -> None:
    """Else it would compile in the foreground: `python benchmarks/cold.py --record`."""
    out = str(tmp_path / "demo")
    told = run(CALLED, "demo", "--frames", "10", "--width", "384", "--out", out)
    called = {json.dumps(row) for row in json.loads(told.splitlines()[-1])}
    recorded = {
        json.dumps([name, list(map(str, types))])
        for kind in ("demo", "refine")
        for name, types in signatures.read(kind)
    }
    assert len(called) > 20
    assert not called - recorded


def test_processes_are_started_once_and_end_with_their_parent(tmp_path: Path) -> None:
    *counts, pids = run(PARENT, NUMBA_CACHE_DIR=str(tmp_path)).splitlines()
    assert len(set(counts)) == 1 and int(counts[0]) == len(pids.split()) > 0
    for pid in pids.split():
        while is_alive(int(pid)):
            time.sleep(0.1)


def test_all_kernels_of_a_kind_are_compiled_and_then_no_process_is_started(tmp_path: Path) -> None:
    cache, few = str(tmp_path), tmp_path / "signatures.json"
    # of tracks, which take a second to compile
    recorded = json.loads(signatures.FILE.read_text())["refine"][1:3]
    few.write_text(json.dumps({"refine": recorded}))
    of_few = "import pathlib; from gsba.compilation import signatures; "
    of_few += f"signatures.FILE = pathlib.Path({str(few)!r})\n"
    program = of_few + "from gsba.compilation.ahead import work; work(['refine'])"
    environment = os.environ | {"NUMBA_CACHE_DIR": cache}
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE) as process:
        assert process.wait() == 0
    kept = sorted(path.suffix for path in (tmp_path / "gsba").iterdir())
    assert kept == [".complete", *[".kernel"] * len(recorded)]
    program = of_few + PARENT.replace('["demo", "refine"], ["refine"], ["demo"]', '["refine"],')
    assert run(program, NUMBA_CACHE_DIR=cache).split() == ["0"]


def test_without_a_cache_nothing_is_begun() -> None:
    program = PARENT.replace('["demo", "refine"], ["refine"], ["demo"]', '["demo"],')
    assert run(program, NUMBA_CACHE_DIR="/proc/none").split() == ["0"]


def is_alive(pid: int) -> bool:
    """True if a process runs: an ended one may wait to be reaped."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
