"""Run folders: their lock, their inputs, and the list of files that gsba wrote (`gsba.json`), so
that other content is refused, and kept by `--fresh`."""

import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsba.disk import (
    disk_errors,
    hold_folder,
    refuse_links,
    remove_temporaries,
    remove_unheld,
    write_text,
)
from gsba.log import GsbaError
from gsba.store.records import RecordError, typed
from gsba.version import __version__

MARKER = "gsba.json"
STAGES = "stages"  # subfolder of intermediate results; all of it is gsba's


def open_run_folder(root: Path, origin: Mapping[str, Path], fresh: bool) -> int:
    """Make or reopen a run folder and lock it against other processes.

    Args:
        origin: inputs of the run, e.g. `{"frames": path, "trajectory": path}`.
        fresh: delete the files that gsba wrote for an earlier run of any inputs.
    Returns:
        File descriptor of the lock: closing it, or the end of the process, releases the folder.
    Raises:
        GsbaError: the folder is of another run, is no run, is locked by another process, or holds
            links or pipes.
    """
    resolved = {name: str(path.resolve()) for name, path in origin.items()}
    with disk_errors(root):
        if root.exists() and not root.is_dir():
            raise GsbaError(f"{root} is a file: choose another --out")
        if root.is_dir() and not is_run_folder(root) and any(root.iterdir()):
            raise GsbaError(f"{root} is not empty and not a gsba run: choose another --out")
        root.mkdir(parents=True, exist_ok=True)
        lock = hold_folder(root)
    try:
        refuse_foreign(root)
        refuse_links(root / STAGES, below=True)
        marker = read_marker(root)
        if marker and fresh:
            # Delete the files that gsba wrote, and then the folders that are empty
            with disk_errors(root):
                if (root / STAGES).exists():
                    shutil.rmtree(root / STAGES)
                remove_unheld(root.glob(".*.partial-*"))  # exports that were stopped
                for name in marker["wrote"]:
                    path = root / name
                    if root.resolve() not in path.resolve().parents:
                        continue  # an edited marker must not reach outside
                    path.unlink(missing_ok=True)
                    for parent in path.relative_to(root).parents:
                        with suppress(OSError):
                            if parent != Path():
                                (root / parent).rmdir()
                (root / MARKER).unlink()
            marker = {}
        if marker and marker["origin"] != resolved:
            raise GsbaError(
                f"{root} holds another run (of {', '.join(marker['origin'].values())}): "
                "choose another --out, or --fresh to replace it"
            )
        remove_temporaries(root)
        _write_marker(root, resolved, marker.get("wrote", ()))
    except BaseException:
        os.close(lock)
        raise
    return lock


def is_run_folder(root: Path) -> bool:
    """True if the folder holds gsba's marker file of a run."""
    return (root / MARKER).is_file()


def check_run_folder(root: Path) -> None:
    """Raise GsbaError if the folder is not that of a run."""
    if not is_run_folder(root):
        raise GsbaError(f"{root} is not a gsba run: give the folder that gsba refine wrote")


def refuse_foreign(root: Path) -> None:
    """Raise GsbaError for links and pipes in a run's folder and in that of its stages."""
    refuse_links(root.resolve())
    refuse_links(root / STAGES)


def claim(root: Path, path: Path) -> None:
    """List a file, or all files of a folder, as written by gsba into the run folder `root`; what
    lies outside of it is not listed."""
    root, path = root.resolve(), path.resolve()
    if not path.is_relative_to(root):
        return
    marker = read_marker(root)
    files = (entry for entry in path.rglob("*") if entry.is_file()) if path.is_dir() else [path]
    names = {entry.relative_to(root).as_posix() for entry in files}
    _write_marker(root, marker["origin"], names.union(marker["wrote"]))


def read_marker(root: Path) -> dict[str, Any]:
    """`gsba.json` as {"gsba": version, "origin": {...}, "wrote": [...]}; {} if missing."""
    path = root / MARKER
    try:
        marker = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise GsbaError(f"{path} is unreadable: choose another --out") from error
    try:
        origin = typed(marker["origin"], dict[str, str])
        wrote = typed(marker["wrote"], list[str])
    except (RecordError, TypeError, KeyError):
        raise GsbaError(f"{path} was not written by gsba: choose another --out") from None
    return marker | {"origin": origin, "wrote": wrote}


def _write_marker(root: Path, origin: Mapping[str, str], wrote: Any) -> None:
    marker = {"gsba": __version__, "origin": origin, "wrote": sorted(wrote)}
    text = json.dumps(marker, indent=1) + "\n"
    write_text(root / MARKER, text)
