"""Folder of an export: written beside its final place and renamed when complete."""

import json
import os
import shutil
import uuid
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsba.disk import disk_errors, hold_folder, refuse_links, remove_temporaries, remove_unheld
from gsba.log import GsbaError, StoppedError
from gsba.placement.world import read_placement
from gsba.version import __version__

MARKER = "export.json"  # {"gsba": version, "format": name, "wrote": top-level entries}


@contextmanager
def output_folder(out: Path, to: str, key: str) -> Iterator[Path]:
    """Folder to write an export into; it becomes `out` when the block ends without an exception.

    An earlier export at `out` is replaced then. After an error the folder is deleted. After an
    interrupt it stays hidden beside `out`: the next call with the same key continues in it, a call
    with another key deletes it.

    Args:
        out: final folder; missing parents are made.
        key: hash of everything that images in the folder depend on.
    Raises:
        GsbaError: `out` is not an earlier export, another process writes it, or the disk cannot be
            written.
    """
    out = out.resolve()
    with disk_errors(out):
        _require_replaceable(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = out.with_name(f".{out.name}.partial-{key[:16]}")
        refuse_links(partial, below=True)  # the folder may come from elsewhere
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
            remove_temporaries(out)  # left by workers that were killed
        except StoppedError:
            raise
        except Exception:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        finally:
            os.close(lock)


def datasets_of_other_maps(run: Path, map_digests: Container[str]) -> dict[str, str]:
    """Format by name of each dataset in a run's folder that holds none of the maps of the run."""
    found = dict[str, str]()
    for path in sorted(run.glob(f"*/{MARKER}")):
        with suppress(OSError, ValueError, TypeError, KeyError, GsbaError):  # edited, or no dataset
            to = json.loads(path.read_text())["format"]
            if read_placement(path.with_name("transform.json")).map_digest not in map_digests:
                found[path.parent.name] = to
    return found


def _require_replaceable(out: Path) -> None:
    """Refuse a folder with files that gsba has not written, as replacing it would lose these."""
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
        strange = repr(min(entries - wrote))
        raise GsbaError(
            f"{out} holds {strange}, which gsba's export did not write: choose another --out, or "
            "move that away"
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
