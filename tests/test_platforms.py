"""Systems without affinity, /proc or wheels."""

import os
import resource
import sys
from pathlib import Path

import pytest

from gsba import memory
from gsba.doctor import examination, machine
from gsba.doctor.packages import Package
from gsba.report import report
from gsba.scans import trial


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system without affinity, /proc and /sys."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    read = Path.read_text

    def read_text(path: Path, *args: str, **options: str) -> str:
        if path.parts[:2] in (("/", "proc"), ("/", "sys")):
            raise FileNotFoundError(2, "No such file or directory", str(path))
        return read(path, *args, **options)

    monkeypatch.setattr(Path, "read_text", read_text)


def test_a_machine_without_affinity_and_proc_is_described(bare: None) -> None:
    found = machine.look()
    assert found.usable_cores == found.cores == os.cpu_count()
    assert found.memory_bytes == memory.total_memory_bytes() == found.free_memory_bytes
    assert found.processor
    described = report._machine()
    assert described["cpus"] == os.cpu_count() and described["memory_mb"] > 0


def test_macos_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr("platform.mac_ver", lambda: ("15.1", ("", "", ""), "arm64"))
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assert machine._system() == "macOS 15.1, arm64"


def test_peak_memory_is_in_bytes_on_macos(monkeypatch: pytest.MonkeyPatch) -> None:
    in_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert memory.peak_memory_bytes() >= 1024 * in_kb
    monkeypatch.setattr(sys, "platform", "darwin")
    assert in_kb <= memory.peak_memory_bytes() < 1024 * in_kb


def test_scans_are_read_where_limits_cannot_be_set(
    bare: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(kind: int, limits: tuple[int, int]) -> None:
        raise ValueError("current limit exceeds maximum limit")

    monkeypatch.setattr(resource, "setrlimit", refuse)
    trial._lower(resource.RLIMIT_AS, 1 << 30)
    assert trial._mapped_bytes() == memory.peak_memory_bytes()


def test_doctor_knows_what_has_no_wheel_on_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    faulty = [Package("pycolmap", None, "is not installed")]
    monkeypatch.setattr(examination, "_platform", lambda: ("linux", "aarch64"))
    assert "build pycolmap from source" in examination._remedy(faulty, [])
    monkeypatch.setattr(examination, "_platform", lambda: ("darwin", "arm64"))
    assert "from source" not in examination._remedy(faulty, [])
