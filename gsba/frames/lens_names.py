"""File names by which cameras mark the two files of one recording, one for each lens."""

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class LensNames:
    """A scheme of file names that include the lens."""

    pattern: re.Pattern[str]  # of a name: groups before, lens, after
    lenses: tuple[str, str]  # names of the front and the back lens, in upper case
    shown: tuple[str, str]  # names of the files in messages
    maker: str = ""  # camera with this scheme; empty = several have it

    def read(self, stem: str) -> tuple[int, str] | None:
        """Lens, 0 front or 1 back, and the frame's name; None = the stem names no lens."""
        found = self.pattern.fullmatch(stem)
        if found is None:
            return None
        name = found["before"] + found["after"].removeprefix("_")
        return self.lenses.index(found["lens"].upper()), name

    def both(self, name: str) -> tuple[str, str] | None:
        """Names of the front and of the back lens's file; None = the name includes no lens."""
        found = self.pattern.fullmatch(name)
        if found is None:
            return None
        lower = found["lens"].islower()
        front, back = (
            f"{found['before']}{lens.lower() if lower else lens}{found['after']}"
            for lens in self.lenses
        )
        return front, back


_CLOCK = LensNames(  # Insta360: VID_..._00_001.insv
    re.compile(r"(?P<before>.*_)(?P<lens>00|10)(?P<after>_.*)"), ("00", "10"), ("_00_", "_10_")
)
FUSION_NAMES = (
    LensNames(
        re.compile(r"(?P<before>GP)(?P<lens>FR|BK)(?P<after>\d.*)", re.IGNORECASE),
        ("FR", "BK"),
        ("GPFR...", "GPBK..."),
        "GoPro Fusion",
    ),
    LensNames(  # further chapters and bursts
        re.compile(r"(?P<before>G)(?P<lens>F|B)(?P<after>\d.*)", re.IGNORECASE),
        ("F", "B"),
        ("GF...", "GB..."),
        "GoPro Fusion",
    ),
)
LENS_NAMES = (_CLOCK, *FUSION_NAMES)


def lens_files(path: Path) -> tuple[Path, Path] | None:
    """Paths of the front and of the back lens's file, if the path is named as one of them."""
    for names in LENS_NAMES:
        both = names.both(path.name)
        if both is not None:
            return path.with_name(both[0]), path.with_name(both[1])
    return None
