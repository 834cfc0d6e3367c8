"""Packages that gsba requires: names, version ranges, and the extras that they belong to."""

import re
import tomllib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

import gsba
from packaging import requirements as requirements_of

NEEDED = ""  # in place of an extra: packages that every run needs
_MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL", "pyyaml": "yaml"}
# Unions of others, extras for developers, and files of weights, whose modules are not imported.
_NOT_EXAMINED = ("all", "docs", "test", "dev", "weights")


@dataclass(frozen=True, slots=True)
class Requirement:
    """Package that gsba requires."""

    name: str  # of the distribution
    module: str  # name of its module
    range: str  # of versions, such as ">=5,<6"
    extra: str  # "" = always needed

    def allows(self, version: str) -> bool:
        """True if a version is in the range, or is no number."""
        try:
            return SpecifierSet(self.range).contains(Version(version), prereleases=True)
        except InvalidVersion:
            return True


def requirements() -> tuple[Requirement, ...]:
    """All required packages, those that are always needed first.

    They are read from pyproject.toml if gsba runs from its source, else from installed metadata.
    """
    project = Path(gsba.__file__).parents[1] / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        lines = [(line, NEEDED) for line in table["dependencies"]]
        for extra, of_extra in table["optional-dependencies"].items():
            lines += [(line, extra) for line in of_extra]
    else:
        lines = []
        for line in metadata.requires("gsba") or ():
            marker = re.search(r"extra\s*==\s*['\"]([^'\"]+)", line)
            lines.append((line, marker[1] if marker else NEEDED))
    kept = [(line, extra) for line, extra in lines if extra not in _NOT_EXAMINED]
    return tuple(_requirement(line, extra) for line, extra in kept)


def _requirement(line: str, extra: str) -> Requirement:
    """Requirement from a line such as `laspy[lazrs]>=2.5`."""
    parsed = requirements_of.Requirement(line)
    name = canonicalize_name(parsed.name)
    return Requirement(
        name, _MODULES.get(name, name.replace("-", "_")), str(parsed.specifier), extra
    )
