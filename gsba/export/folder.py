"""An export's folder: written beside its final place, renamed when complete, never half there."""

import json
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsba.disk import disk_errors, hold_folder, refuse_links, remove_temporaries, remove_unheld
from gsba.log import GsbaError, StoppedError
from gsba.version import __version__

MARKER = "export.json"  # {"gsba": version, "format": name, "wrote": top-level entries}


@contextmanager
def output_folder(out: Path, to: str, key: str) -> Iterator[Path]:
    """Folder to write an export into; it becomes `out` when the block ends without an exception.

    An earlier export at `out` is replaced, and stays as it is until then. After an error nothing
    is left behind. What an interrupt leaves is hidden beside `out`: the next call with the same
    key gets the folder as it was, one with another key has it deleted.

    Args:
        out: final folder; missing parents are made.
        to: name of the format, for the marker.
        key: of all that pictures in the folder depend on.
    Raises:
        GsbaError: `out` is something else than an earlier export, is being written by another
            process, or the disk refuses.
    """
    out = out.resolve()
    with disk_errors(out):
        _require_replaceable(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = out.with_name(f".{out.name}.partial-{key[:16]}")
        refuse_links(partial, below=True)  # a stranger may have left it
        partial.mkdir(exist_ok=True)
        lock = hold_folder(partial)
        remove_unheld(set(out.parent.glob(f".{out.name}.partial-*")) - {partial})
        try:
            yield partial
            wrote = sorted([entry.name for entry in partial.iterdir()] + [MARKER])
            marker = {"gsba": __version__, "format": to, "wrote": wrote}
            (partial / MARKER).write_text(json.dumps(marker, indent=1) + "\n")
            _require_replaceable(out)
            _swap_in(partial, out)
            remove_temporaries(out)  # of workers that were killed
        except StoppedError:
            raise
        except Exception:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        finally:
            os.close(lock)


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
    old = out.with_name(f".{out.name}.partial-old-{uuid.uuid4().hex[:8]}")
    out.rename(old)
    try:
        partial.rename(out)
    except BaseException:
        old.rename(out)
        raise
    shutil.rmtree(old, ignore_errors=True)
