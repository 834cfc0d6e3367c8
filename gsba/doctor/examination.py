"""Examination of every group of packages, with conclusions and text."""

import os
import platform
import shutil
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from gsba.doctor import facts, machine
from gsba.doctor.packages import (
    MAX_MESSAGE_LENGTH,
    NEEDED,
    Package,
    Requirement,
    debian_package,
    look_at,
    requirements,
)
from gsba.log import brief
from gsba.version import __version__

_PURPOSES = {  # extra -> its purpose
    NEEDED: "refine, export, evaluate",
    "video": "frames from video",
    "learned": "ALIKED, DISK, XFeat, SuperPoint, LightGlue",
    "splat": "splats on a GPU",
    "view": "a run in the browser",
    "app": "the page around all commands",
    "plot": "figures",
    "cluster": "work on other processes or machines",
    "imu": "gyros of raw videos",
    "scan": "laser scans and meshes",
}
_OWN = Requirement("gsba", "gsba.pipeline.refine", "", NEEDED)
_WORDS = {"works": "ok", "partly": "partly", "absent": "absent", "broken": "BROKEN"}
_NO_WHEEL = {("linux", "aarch64"): {"pycolmap", "open3d"}}  # as of 2026-11
_ON_ARM = "there is no wheel for Linux on ARM (docs/install.md#linux-on-arm)"


@dataclass(frozen=True, slots=True)
class Group:
    """Packages of one purpose, and their status."""

    name: str  # name of the extra; "" = packages that every run needs
    status: str  # "works", "partly", "absent" (an extra that is not installed) or "broken"
    packages: tuple[Package, ...]
    notes: tuple[str, ...] = ()  # abilities and limits on this machine
    remedy: str = ""  # command that repairs it


@dataclass(frozen=True, slots=True)
class Examination:
    """Findings on this machine and on all groups of packages."""

    version: str  # of gsba
    machine: machine.Machine
    groups: tuple[Group, ...]

    @property
    def works(self) -> bool:
        """True if all packages that a run needs work."""
        return all(group.status == "works" for group in self.groups if group.name == NEEDED)

    def table(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {"works": self.works, **asdict(self)}

    def text(self) -> str:
        """Text for the terminal."""
        found = self.machine
        lines = [
            f"gsba {self.version}, Python {found.python}, {found.system}",
            f"{found.usable_cores:g} of {found.cores} cores ({found.processor}), memory "
            f"{_gb(found.memory_bytes)}, {_gb(found.free_memory_bytes)} of it free; "
            f"{_gb(found.free_disk_bytes)} free on this disk",
            "",
            *(line for group in self.groups for line in _lines(group)),
            "",
            "All packages that a run needs work."
            if self.works
            else "Some packages that a run needs do not work: see BROKEN above.",
        ]
        if found.free_disk_bytes < (2 << 30):
            lines.insert(
                2, "this disk is nearly full: a run takes several times the size of its frames"
            )
        return "\n".join(lines)


def examine() -> Examination:
    """Examine this machine and every package that gsba requires."""
    wanted = requirements()
    names = list(dict.fromkeys(one.extra for one in wanted))
    groups = [[one for one in wanted if one.extra == name] for name in names]
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1)) as pool:
        found = tuple(pool.map(_group, names, groups))
    return Examination(__version__, machine.look(), found)


def _group(name: str, wanted: Sequence[Requirement]) -> Group:
    """Examined group of packages; the needed ones include gsba's own code."""
    facts_name = name if hasattr(facts, name) else ""
    packages, answers = look_at([*wanted, _OWN] if name == NEEDED else wanted, facts_name)
    faulty = [package for package in packages if not package.works]
    if not faulty:
        notes, remedy = _conclusions(answers)
        return Group(name, "partly" if remedy else "works", packages, tuple(notes), remedy)
    if name != NEEDED and all(package.version is None for package in faulty):
        remedy = f"pip install 'gsba[{name}]'"
        if {package.name for package in faulty} & _NO_WHEEL.get(_platform(), set()):
            remedy = _remedy(faulty, wanted)
        return Group(name, "absent", packages, remedy=remedy)
    return Group(name, "broken", packages, remedy=_remedy(faulty, wanted))


def _platform() -> tuple[str, str]:
    return sys.platform, platform.machine()


def _remedy(faulty: Sequence[Package], wanted: Sequence[Requirement]) -> str:
    """Command that installs missing system libraries, or else repairs packages."""
    libraries = dict.fromkeys(lib for package in faulty for lib in package.libraries)
    if libraries and shutil.which("apt-get"):
        return f"apt-get install {' '.join(dict.fromkeys(map(debian_package, libraries)))}"
    if libraries:
        return f"install the system packages that hold {', '.join(libraries)}"
    names = {package.name for package in faulty}
    unbuilt = names & _NO_WHEEL.get(_platform(), set())
    if unbuilt:
        return f"build {', '.join(sorted(unbuilt))} from source: {_ON_ARM}"
    ranges = [f"'{one.name}{one.range}'" for one in wanted if one.name in names]
    if not ranges:  # all packages work, but gsba's own code does not
        return "gsba doctor --json"
    return f"pip install --force-reinstall {' '.join(ranges)}"


def _conclusions(answers: dict[str, Any]) -> tuple[list[str], str]:
    """Notes on the abilities of working packages, and the command that adds missing ones."""
    notes, remedy = [], ""
    if "trouble" in answers:
        notes.append(brief(answers["trouble"], MAX_MESSAGE_LENGTH))
    if "codecs" in answers:
        able = [name for name, decodes in answers["codecs"].items() if decodes]
        lost = [name for name, decodes in answers["codecs"].items() if not decodes]
        notes.append(f"decodes {', '.join(able) or 'nothing'}")
        if lost:
            notes.append(f"cannot decode {', '.join(lost)}")
            remedy = "pip install --force-reinstall --only-binary av av"
    if "weights" in answers:
        at_hand = ", ".join(answers["weights"])
        advice = "no weights yet: see docs/learned.md"
        notes.append(f"weights of {at_hand}" if at_hand else advice)
    if "torch_cuda" in answers:
        note, remedy = _gpu_note(answers)
        notes.append(note)
    if "laz" in answers and not answers["laz"]:
        notes.append("reads LAS, not LAZ")
        remedy = "pip install lazrs"
    return notes, remedy


def _gpu_note(answers: dict[str, Any]) -> tuple[str, str]:
    """Note on the device that splats run on, and the command that makes a GPU usable."""
    if not answers["driver"]:
        return "no NVIDIA device: splats run on the CPU", ""
    if answers["torch_cuda"] is None:
        return (
            "there is a GPU, but this torch is built for the CPU only",
            "pip install --force-reinstall torch",
        )
    if not answers["devices"]:
        return f"the GPU's driver does not support CUDA {answers['torch_cuda']}: update it", (
            "nvidia-smi"
        )
    devices = (
        f"{', '.join(answers['devices'])}, CUDA {answers['torch_cuda']} (gsba is untested on it)"
    )
    if answers["kernels"]:
        return devices, ""
    if answers["compiler"]:
        return f"{devices}; gsplat builds its kernels on first use", ""
    return f"{devices}, but gsplat has no kernels and no nvcc to build them", (
        "apt-get install nvidia-cuda-toolkit"
    )


def _lines(group: Group) -> list[str]:
    """Lines of text on a group: one line, and one more for each broken package."""
    versions = [f"{p.name} {p.version}" for p in group.packages if p.version and p.name != "gsba"]
    purpose = _PURPOSES.get(group.name, "")
    head = f"{_WORDS[group.status]:<7} {group.name or 'needed'}"
    head += f" ({purpose})" if purpose else ""
    details = "; ".join([", ".join(versions), *group.notes] if versions else group.notes)
    lines = [f"{head}: {details}" if details and group.status != "absent" else head]
    if group.status == "broken":
        lines += [f"        {p.name}: {p.fault}" for p in group.packages if not p.works]
    if group.remedy:
        lines.append(f"        $ {group.remedy}")
    return lines


def _gb(count: int) -> str:
    return f"{count / 2**30:.1f} GB"
