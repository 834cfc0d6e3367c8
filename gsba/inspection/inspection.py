"""Inspection of a file or folder: facts as text and as data, and the command to give next."""

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsba import video
from gsba.frames.files import is_image
from gsba.frames.scan import UNSUPPORTED_FORMATS
from gsba.inspection import footage, pictures, runs
from gsba.inspection.footage import Facts
from gsba.log import GsbaError
from gsba.store.folder import is_run_folder


@dataclass(frozen=True, slots=True)
class Inspection:
    """Facts about a path, and the command that refines it."""

    path: str  # the given path
    facts: Facts  # name and text of each
    problem: str  # reason why `refine` would refuse it, one line; "" = it would not
    command: str  # command that refines it, or shows a finished run; "" = none

    def table(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self) | {"facts": dict(self.facts)}

    def text(self) -> str:
        """Lines of text for the terminal."""
        width = max((len(name) for name, _ in self.facts), default=0)
        lines = [f"  {name.ljust(width)}  {text}" for name, text in self.facts]
        end = f"  refused: {self.problem}" if self.problem else f"  {self.command}"
        return "\n".join([self.path, *lines, end]).rstrip()


def inspect(path: Path) -> Inspection:
    """Collect facts about a video, an image, a folder of images or one of a run. Raises GsbaError:
    there is no such file or folder, or it is none of these."""
    if is_run_folder(path):
        facts, command = runs.of_run(path)
        return Inspection(str(path), facts, "", command)
    if path.is_dir():
        found = pictures.of_folder(path)
    elif video.is_video(path):
        found = footage.of_video(path)
    elif is_image(path):
        found = pictures.of_picture(path)  # which alone cannot be refined
    elif path.suffix.lower() in UNSUPPORTED_FORMATS:
        kind = UNSUPPORTED_FORMATS[path.suffix.lower()]
        raise GsbaError(f"{path}: {kind} is not read: convert it to JPEG, PNG, WebP or TIFF")
    elif path.exists():
        raise GsbaError(f"{path} is no video, image or folder of images")
    else:
        raise GsbaError(f"{path}: no such file or folder")
    command = "" if found.problem else shlex.join(["gsba", "refine", str(path)])
    return Inspection(str(path), found.facts, found.problem, command)
