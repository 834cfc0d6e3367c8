"""How cameras name the two files of one recording, one of each lens."""

import re
from pathlib import Path

# What tells both names apart: front, back.
_MARKS = (
    (re.compile(r"(?<=_)(00|10)(?=_)"), ("00", "10")),  # Insta360: VID_..._00_001.insv
    (re.compile(r"^(GPFR|GPBK)(?=\d)", re.IGNORECASE), ("GPFR", "GPBK")),  # GoPro Fusion
    (re.compile(r"^(GF|GB)(?=\d)", re.IGNORECASE), ("GF", "GB")),  # the same, further chapters
)


def lens_files(path: Path) -> tuple[Path, Path] | None:
    """Paths of the front and of the back lens's file, if the path is named as one of them."""
    for pattern, marks in _MARKS:
        found = list(pattern.finditer(path.name))
        if found:
            start, end = found[-1].span()
            lower = found[-1][0].islower()
            front, back = (
                path.with_name(path.name[:start] + (m.lower() if lower else m) + path.name[end:])
                for m in marks
            )
            return front, back
    return None
