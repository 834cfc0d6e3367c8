"""The file chooser: folders and files below one root, and nothing beyond it."""

import os
from pathlib import Path
from typing import Any

from gsba.app.forms import holds_half_characters
from gsba.frames.files import IMAGE_SUFFIXES
from gsba.log import GsbaError, brief
from gsba.store.folder import is_run_folder
from gsba.video.timeline import VIDEO_SUFFIXES

_MAX_ENTRIES = 1000


def inside(root: Path, name: str) -> Path:
    """Path of a name relative to the root, links resolved. Raises GsbaError: it leads out of the
    root."""
    if "\0" in name:
        raise GsbaError("a path holds no NUL characters")
    if holds_half_characters(name):
        raise GsbaError("a path holds no half characters")
    base = root.resolve()
    path = (base / name).resolve()
    if not path.is_relative_to(base):
        raise GsbaError(
            f"{brief(name)} is outside {base}: start gsba app in a folder that holds it"
        )
    return path


def listing(root: Path, name: str) -> dict[str, Any]:
    """Entries of a folder below the root: folders first, hidden ones left out. Raises GsbaError: it
    is no folder, cannot be read, or leads out of the root."""
    folder = inside(root, name)
    try:
        paths = [Path(entry.path) for entry in os.scandir(folder) if not entry.name.startswith(".")]
    except OSError as error:
        raise GsbaError(f"{brief(name) or '.'} cannot be listed: {error.strerror}") from None
    base = root.resolve()
    entries = []
    for path in paths:
        if path.resolve().is_relative_to(base):
            suffix, kind = path.suffix.lower(), "file"
            if path.is_dir():
                kind = "run" if is_run_folder(path) else "folder"
            elif suffix in VIDEO_SUFFIXES or suffix in IMAGE_SUFFIXES:
                kind = "video" if suffix in VIDEO_SUFFIXES else "image"
            size = path.stat().st_size if path.is_file() else None
            place = path.relative_to(base).as_posix()
            entries.append({"name": path.name, "path": place, "kind": kind, "size": size})
    entries.sort(key=lambda entry: (entry["kind"] not in ("run", "folder"), entry["name"].lower()))
    here = folder.relative_to(base).as_posix()
    return {
        "path": here,
        "parent": None if here == "." else folder.parent.relative_to(base).as_posix(),
        "kind": "run" if is_run_folder(folder) else "folder",
        "images": sum(entry["kind"] == "image" for entry in entries),
        "entries": entries[:_MAX_ENTRIES],
        "left_out": max(0, len(entries) - _MAX_ENTRIES),
    }
