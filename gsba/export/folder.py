"""An export's folder: written beside its final place, renamed when complete, never half there."""

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsba.disk import disk_errors, remove_temporaries
from gsba.log import GsbaError
from gsba.version import __version__

MARKER = "export.json"  # {"gsba": version, "format": name, "wrote": top-level entries}


@contextmanager
def output_folder(out: Path, to: str) -> Iterator[Path]:
    """Folder to write an export into; it becomes `out` when the block ends without an exception.

    An earlier export at `out` is replaced, and stays as it is until then. After an error or an
    interrupt nothing is left behind.

    Args:
        out: final folder; missing parents are made.
        to: name of the format, for the marker.
    Raises:
        GsbaError: `out` is something else than an earlier export, or the disk refuses.
    """
    out = out.resolve()
    with disk_errors(out):
        _require_replaceable(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale(out)
        # A name that is never used again: workers elsewhere may still be at an earlier one.
        partial = out.with_name(f".{out.name}.partial-{os.getpid()}-{uuid.uuid4().hex[:8]}")
        partial.mkdir()
        try:
            yield partial
            wrote = sorted([entry.name for entry in partial.iterdir()] + [MARKER])
            marker = {"gsba": __version__, "format": to, "wrote": wrote}
            (partial / MARKER).write_text(json.dumps(marker, indent=1) + "\n")
            _require_replaceable(out)
            _swap_in(partial, out)
            remove_temporaries(out)  # of workers that were killed
        finally:
            shutil.rmtree(partial, ignore_errors=True)


def _require_replaceable(out: Path) -> None:
    """Refuse anything whose replacement would lose what gsba has not written."""
    if not out.exists():
        return
    if not out.is_dir():
        raise GsbaError(f"{out} is a file: choose another --out")
    entries = {entry.name for entry in out.iterdir()}
    try:
        wrote = set(json.loads((out / MARKER).read_text())["wrote"])
    except (OSError, ValueError, TypeError, KeyError):
        wrote = set()
    if entries - wrote:
        kind = "an export and" if wrote else "no export but"
        raise GsbaError(
            f"{out} holds {kind} {min(entries - wrote)!r}: choose another --out, or move it away"
        )


def _swap_in(partial: Path, out: Path) -> None:
    if not out.exists():
        partial.rename(out)
        return
    old = out.with_name(f".{out.name}.partial-{os.getpid()}-old")
    out.rename(old)
    try:
        partial.rename(out)
    except BaseException:
        old.rename(out)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _remove_stale(out: Path) -> None:
    """Delete what killed exports to the same place left half-written."""
    prefix = f".{out.name}.partial-"
    for path in out.parent.glob(f"{prefix}*"):
        pid = path.name.removeprefix(prefix).partition("-")[0]
        if pid.isdigit() and (int(pid) == os.getpid() or not _is_alive(int(pid))):
            shutil.rmtree(path, ignore_errors=True)


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
