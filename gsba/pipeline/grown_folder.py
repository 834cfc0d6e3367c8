"""Folders of runs that grow: written beside, complete, then put in place; the run before is
kept."""

import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from gsba.disk import disk_errors, exchange_folders, hold_folder, link_or_copy
from gsba.log import GsbaError
from gsba.store.folder import STAGES, is_run_folder, read_marker
from gsba.store.records import save_record
from gsba.store.store import RunStore
from gsba.types import FrameSet

logger = logging.getLogger(__name__)

SCRATCH = "new"  # run of new recordings, in the folder that is being written
_FRAMES, _MASKS = "frames", "masks"  # folders of the frames and masks that runs hold themselves
_ODOMETRY = "odometry"  # folder of what the odometry of videos found


@contextmanager
def held_runs(roots: Sequence[Path]) -> Iterator[None]:
    """Keep other processes from runs in this context; GsbaError if one is missing, no run, or in
    use."""
    locks = list[int]()
    try:
        for root in roots:
            if not is_run_folder(root):
                raise GsbaError(f"{root} is not a gsba run: give the folder that gsba refine wrote")
            locks.append(hold_folder(root))
        yield
    finally:
        for lock in locks:
            os.close(lock)


def refuse_existing(out: Path) -> None:
    """Refuse a folder to write a new run to that exists and is not empty, or has no parent."""
    if out.is_symlink() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise GsbaError(f"{out} exists: choose another --out")
    if not out.parent.is_dir():
        raise GsbaError(f"{out.parent} is no folder: make it, or choose another --out")


def forget_other_work(work: Path, origin: dict[str, Path], out: Path) -> None:
    """Delete what a call with other inputs has left half-written in `work`; a finished run whose
    renaming to `out` was interrupted is kept beside it."""
    if not work.exists():
        return
    lock = hold_folder(work)
    try:
        resolved = {name: str(path.resolve()) for name, path in origin.items()}
        if is_run_folder(work) and read_marker(work)["origin"] == resolved:
            return
        with disk_errors(work):
            if (work / "report.json").is_file():
                work.rename(_free_name(out))
                return
            logger.info("%s: left by another call that was interrupted, deleted", work)
            shutil.rmtree(work)
    finally:
        os.close(lock)


def complete(store: RunStore, frames: FrameSet, sources: Sequence[Path], out: Path) -> FrameSet:
    """Give a run all files that its frames and masks are read from, and no other run need hold;
    returns the frames as they are read then."""
    roots = [root.resolve() for root in sources]

    def kept(path: Path, frame: str, folder: str) -> Path:
        own = path.resolve()
        if not any(root in own.parents for root in roots):
            return path
        name = Path(folder) / frame.rpartition("/")[0] / path.name
        if not (store.root / name).is_file():
            link_or_copy(own, store.root / name)
        return out.absolute() / name

    paths, masks = [], []
    for frame, group, mask in zip(frames.names, frames.paths, frames.mask_paths, strict=True):
        paths.append(tuple(kept(path, frame, _FRAMES) for path in group))
        masks.append(mask and kept(mask, frame, _MASKS))
    for root in roots:
        for path in sorted((root / _ODOMETRY).rglob("*")):
            if path.is_file() and root != store.root.resolve():
                link_or_copy(path, store.root / path.relative_to(root))
    for folder in (_FRAMES, _MASKS, _ODOMETRY):
        if (store.root / folder).is_dir():
            store.claim(store.root / folder)
    moved = replace(frames, paths=tuple(paths), mask_paths=tuple(masks))
    info = {"key": store.records["frames"].key} | {
        name: getattr(store.records["frames"], name)
        for name in ("name", "resumed", "seconds", "cpu_seconds", "peak_mb", "workers")
    }
    save_record(store.root / STAGES / "frames.npz", moved, info)
    return moved


def put_in_place(work: Path, out: Path) -> Path | None:
    """Rename a complete run into place; a run that was there gets the name returned."""
    with disk_errors(out):
        shutil.rmtree(work / SCRATCH, ignore_errors=True)
        if not out.exists() or not any(out.iterdir()):
            with suppress(FileNotFoundError):
                out.rmdir()
            work.rename(out)
            return None
        before = _free_name(out)
        if exchange_folders(work, out):
            work.rename(before)
        else:  # for a moment the run has its other name alone
            out.rename(before)
            work.rename(out)
        return before


def _free_name(out: Path) -> Path:
    """Name beside a run's folder under which it can be kept."""
    number, path = 1, out.with_name(f"{out.name}-before")
    while path.exists():
        number += 1
        path = out.with_name(f"{out.name}-before-{number}")
    return path
