"""Trial imports of packages in a separate process, so that a crash is a finding."""

import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata, util
from itertools import chain, islice
from pathlib import Path
from typing import Any

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

import gsba
from gsba.log import brief
from gsba.version import __version__
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
    found = []
    for line, extra in kept:
        parsed = requirements_of.Requirement(line)  # a line such as `laspy[lazrs]>=2.5`
        name = canonicalize_name(parsed.name)
        module = _MODULES.get(name, name.replace("-", "_"))
        found.append(Requirement(name, module, str(parsed.specifier), extra))
    return tuple(found)


_TIMEOUT_S = 120.0
MAX_MESSAGE_LENGTH = 160  # characters of an import's error
_LIBRARY = re.compile(r"([\w.+-]+\.so[\w.]*): cannot open shared object file")
_DEBIAN = {"libglib-2.0.so.0": "libglib2.0-0", "libgthread-2.0.so.0": "libglib2.0-0"}
_CHILD = "import sys; from gsba.doctor.child import answer; answer(sys.argv[1], sys.argv[2:])"


@dataclass(frozen=True, slots=True)
class Package:
    """Package that gsba requires, and its state."""

    name: str
    version: str | None  # None = not installed
    fault: str = ""  # reason why it cannot be used; "" = it can
    libraries: tuple[str, ...] = ()  # missing shared libraries of the system

    @property
    def works(self) -> bool:
        """True if it is installed and can be imported."""
        return self.version is not None and not self.fault


def look_at(
    wanted: Sequence[Requirement], facts: str
) -> tuple[tuple[Package, ...], dict[str, Any]]:
    """Import packages in a separate process.

    Args:
        wanted: packages to import, in this order.
        facts: name of a function of `gsba.doctor.facts` that the process also calls; "" = none.

    Returns:
        state of each package, and the facts; no facts if a package is missing.
    """
    versions = {one.name: _version(one.name) for one in wanted}
    unfit = {}  # reason why a package is not imported; "" = it is
    for one in wanted:
        version = versions[one.name]
        why = "" if version and one.allows(version) else f"{one.range} is needed"
        unfit[one.name] = "is not installed" if version is None else why
    tried = [one for one in wanted if not unfit[one.name]]
    all_there = len(tried) == len(wanted)
    reports, answers = _imported([one.module for one in tried], facts if all_there else "")
    found = []
    for one in wanted:
        version, report = versions[one.name], reports.get(one.module, {})
        fault, libraries = unfit[one.name], ()
        if not fault and "error" in report:
            libraries = _missing_libraries(one.module, report["error"])
            fault = _fault(report, libraries)
        found.append(Package(one.name, version, fault, libraries))
    return tuple(found), answers


def debian_package(library: str) -> str:
    """Debian's package of a shared library, by Debian's naming rule: libX11.so.6 is in libx11-6."""
    if library in _DEBIAN:
        return _DEBIAN[library]
    name, _, number = library.lower().partition(".so")
    number = number.removeprefix(".")
    return f"{name}-{number}" if number and name[-1].isdigit() else f"{name}{number}"


def _version(name: str) -> str | None:
    if name == "gsba":
        return __version__  # gsba may run from its source
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _imported(
    modules: Sequence[str], facts: str
) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Report of each module, and facts; after a crash the rest is imported in a new process."""
    reports: dict[str, dict[str, Any]] = {}
    answers: dict[str, Any] = {}
    rest = list(modules)
    while rest:
        lines, ended = _child(facts, rest)
        for line in lines:
            answers.update(line.get("facts", {}))
            if "module" in line:
                reports[line["module"]] = line
        begun = next((m for m in rest if reports.get(m, {}).get("state") == "begun"), None)
        if begun is None:
            unknown = {"error": ended or "it could not be imported"}
            reports = dict.fromkeys(rest, unknown) | reports
            break
        reports[begun] = {"error": ended}
        rest, facts = rest[rest.index(begun) + 1 :], ""
    return reports, answers


def _child(facts: str, modules: Sequence[str]) -> tuple[list[dict[str, Any]], str]:
    """Lines of a process that imports modules, and its failure; "" = none."""
    path = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}
    call = [sys.executable, "-c", _CHILD, facts, *modules]
    try:
        done = subprocess.run(
            call, env=environment, capture_output=True, timeout=_TIMEOUT_S, check=False
        )
        output, code = done.stdout, done.returncode
    except subprocess.TimeoutExpired as error:
        output, code = error.stdout or b"", None
    lines = [json.loads(line) for line in output.splitlines() if line.startswith(b"{")]
    if code is None:
        return lines, f"its import takes more than {_TIMEOUT_S:.0f} s"
    if code >= 0:
        return lines, "" if code == 0 else f"its import ends Python with code {code}"
    name = signal.Signals(-code).name
    why = ": it is built for another processor" if name == "SIGILL" else ""
    return lines, f"its import crashes Python ({name}){why}"


def _fault(report: dict[str, Any], libraries: Sequence[str]) -> str:
    if libraries:
        return f"lacks {', '.join(libraries)}"
    if report.get("absent"):
        return f"needs {report['absent']}, which is not installed"
    return brief(" ".join(str(report["error"]).split()), MAX_MESSAGE_LENGTH)


def _missing_libraries(module: str, error: str) -> tuple[str, ...]:
    """Shared libraries that a package lacks: the one that its import names, and those of `ldd`."""
    named = _LIBRARY.findall(error)
    if not named:
        return ()
    lacking = dict.fromkeys(named)
    bundled = {path.name for path in _shared_objects(module)}
    for path in islice(_shared_objects(module), 300):
        try:
            listed = subprocess.run(["ldd", path], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            break
        lacking |= dict.fromkeys(re.findall(r"(\S+) => not found", listed.stdout))
    return tuple(name for name in lacking if name in named or name not in bundled)


def _shared_objects(module: str) -> Iterator[Path]:
    spec = util.find_spec(module.partition(".")[0])
    folders = spec.submodule_search_locations if spec else None
    return chain.from_iterable(Path(folder).rglob("*.so*") for folder in folders or ())
