"""The examination: every group of packages tried, what follows from it, and its text."""

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

from gsba.doctor import facts, machine
from gsba.doctor.packages import Package, debian_package, look_at
from gsba.doctor.requirements import NEEDED, Requirement, requirements
from gsba.log import brief
from gsba.version import __version__

_WHAT = {
    NEEDED: "refine, export, evaluate",
    "video": "frames from video",
    "learned": "ALIKED, DISK, XFeat, SuperPoint, LightGlue",
    "splat": "splats on a GPU",
    "view": "a run in the browser",
    "plot": "figures",
    "cluster": "work shared out to other processes or machines",
    "imu": "gyros of raw videos",
    "scan": "laser scans and meshes",
}
_OWN = Requirement("gsba", "gsba.pipeline.refine", "", NEEDED)
_WORDS = {"works": "ok", "partly": "partly", "absent": "absent", "broken": "BROKEN"}
_SMALL_DISK = 2 << 30  # bytes
_MOST_SHOWN = 160  # characters of what a package says


@dataclass(frozen=True, slots=True)
class Group:
    """Packages of one purpose, and whether it can be served."""

    name: str  # of the extra; "" = what every run needs
    status: str  # "works", "partly", "absent" (not asked for) or "broken"
    packages: tuple[Package, ...]
    notes: tuple[str, ...] = ()  # what it can and cannot do here
    remedy: str = ""  # the command to run


@dataclass(frozen=True, slots=True)
class Examination:
    """All that was found."""

    version: str  # of gsba
    machine: machine.Machine
    groups: tuple[Group, ...]

    @property
    def works(self) -> bool:
        """Whether all is there that a run needs."""
        return all(group.status == "works" for group in self.groups if group.name == NEEDED)

    def table(self) -> dict[str, Any]:
        """Plain values, as JSON holds them."""
        return {"works": self.works, **asdict(self)}

    def text(self) -> str:
        """What people read."""
        found = self.machine
        lines = [
            f"gsba {self.version}, Python {found.python}, {found.system}",
            f"{found.usable_cores:g} of {found.cores} cores ({found.processor}), memory "
            f"{_gb(found.memory_bytes)}, of it {_gb(found.free_memory_bytes)} free; "
            f"{_gb(found.free_disk_bytes)} free on disk here",
            "",
            *(line for group in self.groups for line in _lines(group)),
            "",
            "What a run needs works."
            if self.works
            else "What a run needs does not work: see what is BROKEN above.",
        ]
        if found.free_disk_bytes < _SMALL_DISK:
            lines.insert(
                2, "little room on this disk: a run takes several times what its frames do"
            )
        return "\n".join(lines)


def examine() -> Examination:
    """Look at this machine and at every package that gsba asks for."""
    wanted = requirements()
    names = list(dict.fromkeys(one.extra for one in wanted))
    groups = [[one for one in wanted if one.extra == name] for name in names]
    with ThreadPoolExecutor(max(2, os.cpu_count() or 1)) as pool:
        found = tuple(pool.map(_group, names, groups))
    return Examination(__version__, machine.look(), found)


def _group(name: str, wanted: Sequence[Requirement]) -> Group:
    """A group of packages; what every run needs is gsba's own code, too."""
    asked = name if hasattr(facts, name) else ""
    packages, answers = look_at([*wanted, _OWN] if name == NEEDED else wanted, asked)
    faulty = [package for package in packages if not package.works]
    if not faulty:
        notes, remedy = _conclusions(answers)
        return Group(name, "partly" if remedy else "works", packages, tuple(notes), remedy)
    if name != NEEDED and all(package.version is None for package in faulty):
        return Group(name, "absent", packages, remedy=f"pip install 'gsba[{name}]'")
    return Group(name, "broken", packages, remedy=_remedy(faulty, wanted))


def _remedy(faulty: Sequence[Package], wanted: Sequence[Requirement]) -> str:
    """One command: for libraries of the system first, else for packages."""
    libraries = dict.fromkeys(lib for package in faulty for lib in package.libraries)
    if libraries and shutil.which("apt-get"):
        return f"apt-get install {' '.join(dict.fromkeys(map(debian_package, libraries)))}"
    if libraries:
        return f"install what holds {', '.join(libraries)}, by the system's packages"
    names = {package.name for package in faulty}
    ranges = [f"'{one.name}{one.range}'" for one in wanted if one.name in names]
    if not ranges:  # all packages work, gsba's own code does not
        no_place = any("cannot cache" in package.fault for package in faulty)
        return "export NUMBA_CACHE_DIR=/tmp/numba" if no_place else "gsba doctor --json"
    return f"pip install --force-reinstall {' '.join(ranges)}"


def _conclusions(answers: dict[str, Any]) -> tuple[list[str], str]:
    """Notes on what packages that work can do, and the command for what they cannot."""
    notes, remedy = [], ""
    if "trouble" in answers:
        notes.append(brief(answers["trouble"], _MOST_SHOWN))
    if "codecs" in answers:
        able = [name for name, decodes in answers["codecs"].items() if decodes]
        lost = [name for name, decodes in answers["codecs"].items() if not decodes]
        notes.append(f"decodes {', '.join(able) or 'nothing'}")
        if lost:
            notes.append(f"not {', '.join(lost)}")
            remedy = "pip install --force-reinstall --only-binary av av"
    if "weights" in answers:
        at_hand = ", ".join(answers["weights"])
        notes.append(f"weights of {at_hand}" if at_hand else "no weights yet: see --download")
    if "torch_cuda" in answers:
        note, remedy = _on_gpu(answers)
        notes.append(note)
    if "laz" in answers and not answers["laz"]:
        notes.append("reads LAS, not LAZ")
        remedy = "pip install lazrs"
    return notes, remedy


def _on_gpu(answers: dict[str, Any]) -> tuple[str, str]:
    """What splats run on, and the command for a GPU that cannot be used."""
    if not answers["driver"]:
        return "no NVIDIA device: splats run on the CPU", ""
    if answers["torch_cuda"] is None:
        return (
            "a GPU is there, but this torch is for the CPU alone",
            "pip install --force-reinstall torch",
        )
    if not answers["devices"]:
        return f"a GPU is there, but not for CUDA {answers['torch_cuda']}: update its driver", (
            "nvidia-smi"
        )
    devices = f"{', '.join(answers['devices'])}, CUDA {answers['torch_cuda']}"
    if answers["kernels"]:
        return devices, ""
    if answers["compiler"]:
        return f"{devices}; gsplat builds its kernels when they are first used", ""
    return f"{devices}, but gsplat has no kernels and no nvcc to build them", (
        "apt-get install nvidia-cuda-toolkit"
    )


def _lines(group: Group) -> list[str]:
    """What is said of a group: one line, and one for each package that fails."""
    versions = [f"{p.name} {p.version}" for p in group.packages if p.version and p.name != "gsba"]
    what = _WHAT.get(group.name, "")
    head = f"{_WORDS[group.status]:<7} {group.name or 'needed'}" + (f" ({what})" if what else "")
    told = "; ".join([", ".join(versions), *group.notes] if versions else group.notes)
    lines = [f"{head}: {told}" if told and group.status != "absent" else head]
    if group.status == "broken":
        lines += [f"        {p.name}: {p.fault}" for p in group.packages if not p.works]
    if group.remedy:
        lines.append(f"        $ {group.remedy}")
    return lines


def _gb(count: int) -> str:
    return f"{count / 2**30:.1f} GB"
