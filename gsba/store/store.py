"""Store of stage results under keys: it resumes runs and recomputes only changed stages.

A stage's key is the hash of its name and settings, the input files, the keys of the stages before
it, and the version of gsba. Results are in `RUN/stages/NAME.npz`, of a per-frame stage in
`RUN/stages/NAME/FRAME.npz`.
"""

import dataclasses
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

from pydantic import BaseModel

from gsba.disk import FullDiskError, link_or_copy, write_text
from gsba.log import GsbaError, brief, event
from gsba.memory import give_back_freed_memory, peak_memory_bytes, release_mapped_files
from gsba.store.folder import STAGES, check_run_folder, claim, open_run_folder, refuse_foreign
from gsba.store.records import (
    FORMAT,
    MIN_MAPPED_BYTES,
    RecordError,
    load_keyed,
    load_record,
    read_info,
    save_record,
    typed,
)
from gsba.store.shards import StoredRecords, Threads, Workers, even_blocks
from gsba.version import __version__

logger = logging.getLogger(__name__)
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True, slots=True)
class StageRecord:
    """Cost of a stage. A resumed stage shows the cost of the call that computed it."""

    name: str
    key: str  # hash of all the result depends on
    resumed: bool  # True = the result is of an earlier call
    seconds: float  # wall clock
    cpu_seconds: float  # all threads of the process, and of remote workers
    peak_mb: float  # high-water mark of the process's resident memory when the stage ended
    workers: int = 0  # number of remote workers that took part
    serial_cpu_seconds: float = 0.0  # of cpu_seconds, those of the thread that computed the stage:
    # where threads share the work, it only waits for them


class RunStore:
    """One run's folder, locked by one process at a time; use as a context manager.

    Args:
        origin: inputs of the run, e.g. `{"frames": path, "trajectory": path}`.
        fresh: delete the files that gsba wrote for an earlier run in `root`, and only these.
        hire: makes the workers of the stages from the folder of shards; None = one thread.

    Raises:
        GsbaError: the folder is of another run, is no run, or is locked by another process.
    """

    def __init__(
        self,
        root: Path,
        origin: Mapping[str, Path],
        fresh: bool = False,
        hire: Callable[[Path], Workers] | None = None,
        title_of: Callable[[str], str] = str,
    ) -> None:
        self.root = root
        self._title_of = title_of
        self.records: dict[str, StageRecord] = {}  # stages of this call, in order
        self.seconds_again = 0.0  # of stages of this call that it computed again later
        self._computed: set[str] = set()  # stages that this call computed
        self._resumed: dict[str, float] = {}  # stage -> seconds, not told of yet
        self._types: dict[str, object] = {}  # stage -> type of its result
        self._prefix = ""
        self._lock = open_run_folder(root, origin, fresh)
        try:
            self.workers = Threads(1) if hire is None else hire(self.shards_folder)
        except BaseException:
            os.close(self._lock)
            raise

    def __enter__(self) -> "RunStore":
        return self

    def __exit__(self, _: Any = None, error: BaseException | None = None, __: Any = None) -> None:
        self._tell_resumed()
        os.close(self._lock)
        if isinstance(error, FullDiskError):
            raise FullDiskError(f"{error}; finished stages are kept") from error

    @property
    def shards_folder(self) -> Path:
        """Folder of the workers' files, emptied when a stage is stored."""
        return self.root / STAGES / "shards"

    @property
    def parts_folder(self) -> Path:
        """Folder of maps that a stage solves in parts, deleted when the stage is stored."""
        return self.root / STAGES / "parts"

    @property
    def scratch_folder(self) -> Path:
        """Folder for unnamed temporary files."""
        return self.root / STAGES

    @contextmanager
    def named(self, prefix: str) -> Iterator[None]:
        """Name stages within this context, and the stages they follow, `prefix-NAME`."""
        before, self._prefix = self._prefix, f"{prefix}-"
        try:
            yield
        finally:
            self._prefix = before

    def stage(
        self,
        name: str,
        settings: object,
        compute: Callable[[], T],
        returns: type[T],
        after: Sequence[str] = (),
    ) -> T:
        """Result of a stage: the stored one if its key matches, else computed and stored.

        Args:
            settings: everything `compute` depends on besides earlier stages: settings models,
                `fingerprint(...)` of input files, numbers, ... (see `digest`).
            returns: type of the result, a record of gsba.types or a tuple of such.
            after: names of earlier stages of this call whose results `compute` uses.

        Raises:
            ValueError: a stage of this call has this name and another type of result.
        """
        key = self._key(name, settings, after)
        name = self._prefix + name
        if self._types.setdefault(name, returns) != returns:
            raise ValueError(f"stage {name} has results of two types: rename one of them")
        path = _stage_path(self.root, name)
        stored = _load_if_current(path, key, returns)
        if stored is not None:
            value, record = stored
            self._note(replace(record, resumed=True), value)
            return value
        event("stage", name=name, title=self._title_of(name))
        measured = _measuring(name, key, self.workers)
        with _named_in_memory_errors(name):
            value = compute()
        record = measured()
        save_record(path, value, dataclasses.asdict(record))
        self._forget_shards()
        self._note(record, value)
        with suppress(OSError, RecordError):  # large arrays stay on the disk from here on
            if path.stat().st_size >= MIN_MAPPED_BYTES:
                value = load_record(path, returns, mapped=True)
        give_back_freed_memory()  # freed by this stage's threads: other threads do not reuse it
        release_mapped_files()
        return value

    def per_frame(
        self,
        name: str,
        settings: object,
        items: Mapping[str, object],
        compute: Callable[[str], T],
        returns: type[T],
        after: Sequence[str] = (),
        alone: bool = False,
    ) -> "PerFrame[T]":
        """Results of a stage that computes every frame independently, one file each.

        Args:
            items: frame name -> inputs of this frame's result besides `settings`, e.g.
                `fingerprint(paths)`; only frames whose entry changed are computed again.
            compute: makes the result of the named frame; remote workers need it to be a `Taken`.
            alone: compute one frame at a time, in this process.
        """
        base = self._key(name, settings, after)
        name = self._prefix + name
        keys = {item: digest(base, item, depends) for item, depends in items.items()}
        folder = self.root / STAGES / name
        frames = PerFrame(folder, keys, compute, returns)
        for path in {*folder.rglob("*.npz")} - {folder / f"{item}.npz" for item in keys}:
            path.unlink()  # results of frames that are not among these
        missing, spent = [item for item in frames if not frames.is_stored(item)], None
        with suppress(OSError, ValueError, RecursionError, RecordError):
            spent = typed(json.loads((folder / "cost.json").read_text()), StageRecord)
        if spent is not None and (spent.key != base or len(missing) == len(keys)):
            spent = None  # of another stage, or of results that are gone
        workers = Threads(1) if alone else self.workers
        measured = _measuring(name, base, workers, spent)
        if missing:
            event("stage", name=name, title=self._title_of(name))
        try:
            with _named_in_memory_errors(name):
                for _ in workers.map_shards(_Missing(name, frames, tuple(missing))):
                    pass
        finally:
            record = measured()
            write_text(folder / "cost.json", json.dumps(dataclasses.asdict(record)))
        self._forget_shards()
        self._note(replace(record, key=digest(base, keys), resumed=not missing))
        return frames

    def adopt(
        self, name: str, files: Mapping[str, Path], compute: Callable[[str], T], returns: type[T]
    ) -> "PerFrame[T]":
        """Results of a per-frame stage that another run has stored in files (frame name -> file),
        as results of this one; computed where a file is missing."""
        folder, keys = self.root / STAGES / name, {}
        for frame, source in files.items():
            path, known = folder / f"{frame}.npz", _stored_key(source)
            if known is not None and known != _stored_key(path):
                link_or_copy(source, path)
            keys[frame] = _stored_key(path) or digest(__version__, FORMAT, name, frame)
        return PerFrame(folder, keys, compute, returns)

    def stored(
        self, name: str, settings: object, returns: type[T], after: Sequence[str] = ()
    ) -> T | None:
        """Stored result that `stage` would return; None if it would compute one."""
        key = self._key(name, settings, after)
        found = _load_if_current(_stage_path(self.root, self._prefix + name), key, returns)
        return None if found is None else found[0]

    def forget(self, name: str) -> None:
        """Delete the stored result of a stage, so that it is computed again."""
        _stage_path(self.root, name).unlink(missing_ok=True)

    def forget_frames(self, name: str) -> None:
        """Delete the stored results of a per-frame stage that this call does without."""
        shutil.rmtree(self.root / STAGES / (self._prefix + name), ignore_errors=True)

    def _forget_shards(self) -> None:
        """Delete the shards and the maps in parts of a stage whose result is stored."""
        for path in self.shards_folder.glob("*"):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.parts_folder, ignore_errors=True)

    def claim(self, path: Path) -> None:
        """List a final output (a file, or a folder with all its files) as written by gsba."""
        claim(self.root, path)

    def _key(self, name: str, settings: object, after: Sequence[str]) -> str:
        keys = [self.records[self._prefix + stage].key for stage in after]
        return digest(__version__, FORMAT, self._prefix + name, settings, keys)

    def _note(self, record: StageRecord, value: object = None) -> None:
        if not record.resumed and record.name in self._computed:
            self.seconds_again += self.records[record.name].seconds
        self.records[record.name] = record
        how = "resumed, computed in" if record.resumed else "done in"
        title, name = self._title_of(record.name), record.name
        detailed = logger.isEnabledFor(logging.DEBUG) and title != name
        shown = f"{title} [{name}]" if detailed else title
        level = logging.DEBUG if record.resumed else logging.INFO
        if record.resumed and name not in self._computed:
            self._resumed[name] = record.seconds
        elif not record.resumed:
            self._computed.add(name)
            self._tell_resumed()
        logger.log(level, "%s: %s %.1f s, %.0f MB", shown, how, record.seconds, record.peak_mb)
        cost = {"seconds": round(record.seconds, 3), "resumed": record.resumed}
        event("done", name=name, title=title, **cost)

    def _tell_resumed(self) -> None:
        """Log in a line how many stages were resumed since the last such line."""
        if self._resumed:
            seconds = sum(self._resumed.values())
            num = f"{len(self._resumed)} stage{'s' * (len(self._resumed) > 1)}"
            logger.info("resumed %s of an earlier call, which took %.0f s", num, seconds)
            self._resumed.clear()


@runtime_checkable
class Taken(Protocol[T_co]):
    """Per-frame computation that can be restricted to some frames, for remote workers."""

    def __call__(self, name: str) -> T_co:
        """Result of the named frame."""
        ...

    def taken(self, names: Sequence[str]) -> "Taken[T_co]":
        """Computation of these frames alone; it can be pickled."""
        ...


class PerFrame(Generic[T]):
    """Results of a per-frame stage: frame name -> record, read from disk on each access.

    A missing, outdated or damaged file is computed again.
    """

    def __init__(
        self, folder: Path, keys: Mapping[str, str], compute: Callable[[str], T], returns: type[T]
    ) -> None:
        self._folder = folder
        self._keys = keys
        self._compute = compute
        self._returns = returns

    def __len__(self) -> int:
        return len(self._keys)

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __getitem__(self, name: str) -> T:
        path, key = self._path(name), self._keys[name]
        if path.exists():
            try:
                found = load_keyed(path, key, self._returns)
                if found is not None:
                    return found
            except RecordError as error:
                logger.warning("computing again: %s", error)
        value = self._compute(name)
        save_record(path, value, {"key": key})
        return value

    def is_stored(self, name: str) -> bool:
        """True if a result with the current key is on disk."""
        try:
            return read_info(self._path(name)).get("key") == self._keys[name]
        except RecordError:
            return False

    def taken(self, names: Sequence[str]) -> "PerFrame[T]":
        """Results of some frames, with absolute paths for remote workers."""
        compute = self._compute.taken(names) if isinstance(self._compute, Taken) else self._compute
        keys = {name: self._keys[name] for name in names}
        return PerFrame(self._folder.absolute(), keys, compute, self._returns)

    def records(self, names: Mapping[int, str]) -> StoredRecords[T]:
        """Stored records of frames, by the numbers that `names` gives them."""
        paths = {number: self._path(name).absolute() for number, name in names.items()}
        keys = {number: self._keys[name] for number, name in names.items()}
        return StoredRecords(paths, keys, self._returns)

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.npz"


@dataclass(frozen=True, slots=True)
class _Missing:
    """Job that computes and stores the frames without a stored result."""

    title: str
    frames: PerFrame[Any]
    names: tuple[str, ...]
    returns: Any = NoneType

    def __len__(self) -> int:
        return len(self.names)

    def __call__(self, item: int) -> None:
        self.frames[self.names[item]]

    def blocks(self) -> Sequence[tuple[int, int]]:
        return even_blocks(len(self.names))

    def part(self, start: int, stop: int) -> "_Missing":
        names = self.names[start:stop]
        return replace(self, frames=self.frames.taken(names), names=names)


def load_stage(root: Path, name: str, returns: type[T]) -> T:
    """Result of a finished stage of a run with any settings; GsbaError if `root` is no gsba run or
    holds links, or the stage is missing or damaged."""
    check_run_folder(root)
    refuse_foreign(root)
    try:
        return load_record(_stage_path(root, name), returns)
    except RecordError as error:
        raise GsbaError(
            f"{root} has no usable {name!r} result ({brief(str(error), 200)}): run gsba refine "
            f"with --out {root} to the end"
        ) from error


def digest(*parts: object) -> str:
    """SHA-256 of JSON-able values, settings models, dataclasses and paths; equal across calls."""
    text = json.dumps(parts, sort_keys=True, default=_jsonable)
    return hashlib.sha256(text.encode()).hexdigest()


def fingerprint(paths: Iterable[Path | None]) -> tuple[tuple[str, int, int] | None, ...]:
    """Resolved path, size in bytes and modification time in ns of each input file; None where there
    is no file, so that a file of one frame is never taken for that of another."""
    stats = ((path.resolve(), path.stat()) if path is not None else None for path in paths)
    return tuple(one and (str(one[0]), one[1].st_size, one[1].st_mtime_ns) for one in stats)


def _jsonable(value: object) -> object:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {entry.name: getattr(value, entry.name) for entry in dataclasses.fields(value)}
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a stage's key")


@contextmanager
def _named_in_memory_errors(stage: str) -> Iterator[None]:
    try:
        yield
    except MemoryError as error:
        error.add_note(stage)
        raise


def _stage_path(root: Path, name: str) -> Path:
    return root / STAGES / f"{name}.npz"


def _stored_key(path: Path) -> str | None:
    """Key that a record was stored with; None if it cannot be read."""
    with suppress(RecordError):
        return str(read_info(path).get("key"))
    return None


def _load_if_current(path: Path, key: str, returns: type[T]) -> tuple[T, StageRecord] | None:
    """Stored result and its cost; None if there is no usable result with this key."""
    if not path.exists():
        return None
    try:
        info = read_info(path)
        if info.get("key") != key:
            logger.debug("%s: settings or inputs changed, computing again", path.stem)
            return None
        return load_record(path, returns, mapped=True), typed(info, StageRecord)
    except RecordError as error:
        logger.warning("%s: stored result is unusable, computing again (%s)", path.stem, error)
        return None


def _measuring(
    name: str, key: str, workers: Workers, spent: StageRecord | None = None
) -> Callable[[], StageRecord]:
    """Function that gives the cost of a stage since now, added to that `spent` by an interrupted
    call."""
    wall, cpu, own = time.perf_counter(), time.process_time(), time.thread_time()
    before = workers.spent()

    def measured() -> StageRecord:
        elsewhere, seconds = workers.spent(), time.perf_counter() - wall
        cpu_seconds, serial = time.process_time() - cpu, time.thread_time() - own
        cpu_seconds += elsewhere.cpu_seconds - before.cpu_seconds
        took_part = [w for w, n in elsewhere.shards.items() if n > before.shards.get(w, 0)]
        peak_mb = peak_memory_bytes() / 2**20
        if spent is not None:
            seconds += spent.seconds
            cpu_seconds += spent.cpu_seconds
            serial += spent.serial_cpu_seconds
            peak_mb = max(peak_mb, spent.peak_mb)
        figures = seconds, cpu_seconds, peak_mb, len(took_part), serial
        return StageRecord(name, key, False, *figures)

    return measured
