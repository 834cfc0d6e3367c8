"""The examination of an installation: packages that are broken in every way are findings."""

import importlib.machinery
import importlib.util
import json
import os
import shutil
import tomllib
from pathlib import Path

import pytest
import simplejpeg
from command import run_gsba

from gsba.doctor import examination, examine, facts
from gsba.doctor.machine import look
from gsba.doctor.packages import NEEDED, Requirement, debian_package, look_at, requirements

ROOT = Path(__file__).parents[2]


def _package(folder: Path, name: str, code: str, version: str = "1.2.3") -> Requirement:
    """An installed package of one module."""
    (folder / name).mkdir()
    (folder / name / "__init__.py").write_text(code)
    (folder / f"{name}-{version}.dist-info").mkdir()
    text = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    (folder / f"{name}-{version}.dist-info" / "METADATA").write_text(text)
    return Requirement(name, name, ">=1,<2", "")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_what_gsba_asks_for_is_what_its_project_says() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = requirements()
    assert len([one for one in wanted if one.extra == NEEDED]) == len(project["dependencies"])
    extras = set(project["optional-dependencies"]) - {"all", "docs", "test", "dev", "weights"}
    assert {one.extra for one in wanted} == {NEEDED, *extras}
    for one in wanted:
        if one.extra == NEEDED:
            assert importlib.util.find_spec(one.module) is not None, one
        assert one.range, one
    assert extras <= examination._PURPOSES.keys()


@pytest.mark.parametrize(
    ("version", "bounds", "allowed"),
    [
        ("2.13.0+cpu", ">=2.4,<=2.13.0", True),
        ("2.14.0", ">=2.4,<=2.13.0", False),
        ("5.0.0.93", ">=4.10", True),
        ("0.10.0", ">=0.9,<0.10", False),
        ("0.9.12", ">=0.9,<0.10", True),
        ("unknown", ">=1", True),
    ],
)
def test_ranges_of_versions(version: str, bounds: str, allowed: bool) -> None:
    assert Requirement("a", "a", bounds, "").allows(version) == allowed


def test_packages_that_break_in_every_way_are_told_apart(site: Path) -> None:
    wanted = [
        _package(site, "noisy", "print('{\"module\": \"late\"}'); import os; os.write(1, b'{')"),
        _package(site, "crashes", "import os, signal; os.kill(os.getpid(), signal.SIGILL)"),
        _package(site, "leaves", "import os; os._exit(7)"),
        _package(site, "old", "", "0.9"),
        Requirement("absent", "absent", ">=1", ""),
        _package(site, "needs", "import what_is_not_there"),
        _package(site, "fails", "raise RuntimeError('one\\ntwo')"),
        _package(site, "late", ""),
    ]
    packages, answers = look_at(wanted, "video")
    assert answers == {}
    assert {package.name: package.fault for package in packages} == {
        "noisy": "",
        "crashes": "its import crashes Python (SIGILL): it is built for another processor",
        "leaves": "its import ends Python with code 7",
        "old": ">=1,<2 is needed",
        "absent": "is not installed",
        "needs": "needs what_is_not_there, which is not installed",
        "fails": "RuntimeError: one two",
        "late": "",
    }
    assert [package.works for package in packages] == [True, *[False] * 6, True]


def test_libraries_of_the_system_that_are_missing_are_all_named(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("ldd") is None:
        pytest.skip("no ldd here")
    wanted = _package(site, "drawing", "import drawing._native")
    suffix = importlib.machinery.EXTENSION_SUFFIXES[0]
    (binary,) = Path(simplejpeg.__file__).parent.glob(f"*{suffix}")
    content = binary.read_bytes()
    assert b"\0libc.so.6\0" in content
    broken = content.replace(b"\0libc.so.6\0", b"\0libQ.so.6\0")
    (site / "drawing" / f"_native{suffix}").write_bytes(broken)
    other = content.replace(b"\0libc.so.6\0", b"\0libW.so.6\0")
    (site / "drawing" / f"_other{suffix}").write_bytes(other)
    (package,), _ = look_at([wanted], "")
    assert package.libraries == ("libQ.so.6", "libW.so.6")
    assert package.fault == "lacks libQ.so.6, libW.so.6"
    monkeypatch.setattr(shutil, "which", lambda _: "/usr/bin/apt-get")
    assert examination._remedy([package], [wanted]) == "apt-get install libq6 libw6"
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert "libQ.so.6, libW.so.6" in examination._remedy([package], [wanted])


@pytest.mark.parametrize(
    ("library", "package"),
    [
        ("libGL.so.1", "libgl1"),
        ("libX11.so.6", "libx11-6"),
        ("libgomp.so.1", "libgomp1"),
        ("libusb-1.0.so.0", "libusb-1.0-0"),
        ("libglib-2.0.so.0", "libglib2.0-0"),
    ],
)
def test_debian_names_packages_after_libraries(library: str, package: str) -> None:
    assert debian_package(library) == package


def test_a_process_that_cannot_start_is_no_clean_bill(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = [_package(site, "fine", "")]
    monkeypatch.setattr("gsba.doctor.packages._CHILD", "raise SystemExit(3)")
    (package,), _ = look_at(wanted, "")
    assert package.fault == "its import ends Python with code 3"


def _examined(monkeypatch: pytest.MonkeyPatch, *wanted: Requirement):
    monkeypatch.setattr(examination, "requirements", lambda: wanted)
    monkeypatch.setattr(examination, "_OWN", Requirement("gsba", "gsba.version", "", NEEDED))
    return run_gsba("doctor"), run_gsba("doctor", "--json")


def test_what_a_run_needs_decides_the_exit_code(
    site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fine = _package(site, "fine", "")
    extra = Requirement("unheard_of", "unheard_of", ">=1", "view")
    text, table = _examined(monkeypatch, fine, extra)
    assert text.exit_code == table.exit_code == 0
    assert "All packages that a run needs work." in text.stdout and "fine 1.2.3" in text.stdout
    assert "absent  view" in text.stdout and "$ pip install 'gsba[view]'" in text.stdout
    found = json.loads(table.stdout)
    assert found["works"] and [group["status"] for group in found["groups"]] == ["works", "absent"]
    bad = _package(site, "bad", "raise ImportError('no such symbol')")
    text, table = _examined(monkeypatch, fine, bad)
    assert text.exit_code == table.exit_code == 1 and not json.loads(table.stdout)["works"]
    assert "bad: ImportError: no such symbol" in text.stdout
    assert "$ pip install --force-reinstall 'bad>=1,<2'" in text.stdout


def test_a_broken_extra_is_no_failure(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fine = _package(site, "fine", "")
    _package(site, "worn", "raise ImportError('torn')")
    text, _ = _examined(monkeypatch, fine, Requirement("worn", "worn", "", "view"))
    assert text.exit_code == 0 and "BROKEN  view" in text.stdout


@pytest.mark.parametrize(
    ("changed", "told", "remedy"),
    [
        ({"driver": False}, "no NVIDIA device", ""),
        ({"torch_cuda": None}, "for the CPU only", "pip install --force-reinstall torch"),
        ({"devices": []}, "driver does not support CUDA", "nvidia-smi"),
        ({"kernels": True}, "H200, CUDA 12.6", ""),
        ({"compiler": "/usr/bin/nvcc"}, "builds its kernels", ""),
        ({}, "no kernels and no nvcc", "apt-get install nvidia-cuda-toolkit"),
    ],
)
def test_what_a_gpu_is_good_for(changed: dict, told: str, remedy: str) -> None:
    answers = {"driver": True, "torch_cuda": "12.6", "devices": ["H200"], "kernels": False}
    notes, found = examination._conclusions(answers | {"compiler": None} | changed)
    assert told in notes[0] and found == remedy


def test_notes_on_extras() -> None:
    codecs = dict.fromkeys(facts.CODECS, True) | {"av1": False}
    notes, remedy = examination._conclusions({"codecs": codecs})
    assert notes[1] == "cannot decode av1" and remedy.startswith("pip install")
    advice = examination._conclusions({"weights": []})[0][0]
    assert advice.startswith("no weights yet: see docs/learned")
    assert examination._conclusions({"weights": ["disk (MIT)"]}) == (["weights of disk (MIT)"], "")
    assert examination._conclusions({"laz": False}) == (["reads LAS, not LAZ"], "pip install lazrs")
    assert examination._conclusions({"trouble": "OSError: x"}) == (["OSError: x"], "")


def test_pyav_decodes_what_cameras_write() -> None:
    pytest.importorskip("av")
    assert facts.video()["codecs"].keys() == set(facts.CODECS)
    assert facts.video()["codecs"]["h264"] and facts.video()["codecs"]["hevc"]


def test_weights_in_the_caches_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("TORCH_HOME", "HF_HOME", "HF_HUB_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("gsba.learned.weights.packaged", lambda names: None)
    assert facts.learned() == {"weights": []}
    folder = tmp_path / "torch" / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    (folder / "depth-save.pth").write_bytes(b"x")
    assert facts.learned() == {"weights": ["disk (Apache-2.0)"]}


def test_the_limits_of_a_container_are_those_of_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsba.doctor.machine._CGROUP", tmp_path)
    assert look().usable_cores == len(os.sched_getaffinity(0))
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text(f"{1 << 29}\n")
    (tmp_path / "memory.current").write_text(f"{1 << 28}\n")
    found = look()
    assert found.usable_cores == 0.5 and found.memory_bytes == 1 << 29
    assert 0 < found.free_memory_bytes <= 1 << 28
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert look().memory_bytes > 1 << 29


def test_here_all_that_a_run_needs_works() -> None:
    found = examine()
    assert found.works, found.text()
    assert found.groups[0].name == NEEDED
