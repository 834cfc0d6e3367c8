"""Files that a browser drops into the page's folder: streamed to a hidden file beside the final
one, whose name holds size and time of change, so that the same file dropped again goes on from
there."""

import errno
import fcntl
import math
import os
import re
import shutil
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from gsba.app.browse import inside
from gsba.app.forms import holds_half_characters
from gsba.disk import disk_errors
from gsba.frames.files import IMAGE_SUFFIXES
from gsba.log import GsbaError, brief
from gsba.store.folder import MARKER, is_run_folder
from gsba.video.timeline import VIDEO_SUFFIXES

# Files that commands take beside footage.
_BESIDE = (".tum", ".csv", ".txt", ".gpx", ".json", ".srt", ".ply", ".las", ".laz", ".toml")
_PART = re.compile(r"^\.(?P<name>.+)\.(?P<size>\d+)-(?P<modified>\d+)\.gsba-drop$", re.DOTALL)
_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f-\x9f/\\:*?"<>|]')
_MAX_NAME = 180  # bytes, so that names beside it fit
_MAX_DEPTH, _MAX_NAMES = 4, 100  # folders in a dropped path; files tried as NAME-2, NAME-3, ...
_SPARE = 100 * 2**20  # bytes of the disk that stay free


@dataclass(frozen=True, slots=True)
class Drop:
    """A dropped file and where it goes."""

    folder: Path  # absolute; it may not exist yet
    name: str  # final name
    size: int  # bytes
    modified: int  # ms since 1970, by the browser

    @property
    def final(self) -> Path:
        """Path of the whole file."""
        return self.folder / self.name

    @property
    def part(self) -> Path:
        """Path of what has arrived."""
        return self.folder / f".{self.name}.{self.size}-{self.modified}.gsba-drop"

    @property
    def arrived(self) -> int:
        """Bytes that have arrived."""
        return self.part.stat().st_size if self.part.is_file() else 0

    @property
    def is_here(self) -> bool:
        """True if the whole file was dropped before."""
        if not self.final.is_file():
            return False
        found = self.final.stat()
        # ms: times of change on FAT are the coarsest
        near = abs(found.st_mtime_ns / 1e6 - self.modified) <= 2000
        return found.st_size == self.size and near


def plan(root: Path, folder: str, files: Sequence[Any]) -> list[dict[str, Any]]:
    """Where dropped files go, how much of each is here, and which are refused.

    Args:
        folder: in it, where they were dropped.
        files: of each "name", which may be a path in a dropped folder, "size" in bytes and
            "modified" in ms since 1970.

    Returns:
        of each "path" relative to the root, "size", "offset", "state" ("new", "unfinished" or
        "here"), "renamed", True if the name was taken, and "error", "" = it is taken.

    Raises:
        GsbaError: nothing can be dropped there.
    """
    target, found, promised = _target(root, folder), [], dict[Path, Drop]()
    on_their_way = cache(lambda where: unfinished(where) if where.is_dir() else [])
    existing = next(each for each in (target, *target.parents) if each.is_dir())
    free = shutil.disk_usage(existing).free - _SPARE
    for one in files:
        try:
            drop, renamed = _placed(root, target, one, promised, on_their_way)
            left = 0 if drop.is_here else drop.size - drop.arrived
            if left > free:
                raise GsbaError(_no_room(drop, left, free))
            free -= left
        except GsbaError as error:
            found.append({"error": str(error)})
            continue
        promised[drop.final] = drop
        state = "here" if drop.is_here else "unfinished" if drop.part.is_file() else "new"
        found.append(
            {
                "path": drop.final.relative_to(root.resolve()).as_posix(),
                "size": drop.size,
                "modified": drop.modified,
                "offset": drop.arrived,
                "state": state,
                "renamed": renamed,
                "error": "",
            }
        )
    return found


class Arrival:
    """A part of a dropped file on its way to the disk; other pages wait for its end.

    Args:
        path: final path relative to the root, as `plan` gave it.
        size, modified: of the dropped file.
        offset: byte at which the part begins.

    Raises:
        GsbaError: the path is not allowed, another page sends the file, the part does not begin
            where the file ends so far, or the disk has no room.
    """

    def __init__(self, root: Path, path: str, size: int, modified: int, offset: int) -> None:
        parts = _cleaned(path)
        if "/".join(parts) != path:
            raise GsbaError(f"{brief(path)} is no name for a dropped file")
        _refuse_other_files(parts[-1])
        folder = _target(root, "/".join(parts[:-1]))
        self.drop = Drop(folder, parts[-1], size, modified)
        with disk_errors(self.drop.final):
            folder.mkdir(parents=True, exist_ok=True)
            how = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
            self._file = os.open(self.drop.part, how, 0o644)
        try:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise GsbaError(f"{self.drop.name} is being sent by another page") from None
            self._arrived = os.fstat(self._file).st_size
            if self._arrived != offset:
                raise GsbaError(
                    f"{self.drop.name} has arrived up to byte {self._arrived}: drop it again"
                )
            left, free = size - offset, shutil.disk_usage(folder).free - _SPARE
            if left > free:
                raise GsbaError(_no_room(self.drop, left, free))
        except BaseException:
            self.close()
            raise

    def write(self, content: bytes) -> None:
        """Append bytes. Raises GsbaError: there are more than announced, or the disk is full."""
        if self._arrived + len(content) > self.drop.size:
            raise GsbaError(f"{self.drop.name} is longer than announced: drop it again")
        try:
            while content:
                num = os.write(self._file, content)
                self._arrived, content = self._arrived + num, content[num:]
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                left = self.drop.size - self._arrived
                raise GsbaError(_no_room(self.drop, left, 0)) from None
            raise GsbaError(f"{self.drop.name} cannot be written: {error.strerror}") from None

    def finish(self) -> dict[str, Any]:
        """Give the file its final name if it is whole.

        Returns:
            "offset", bytes that have arrived, and "done".

        Raises:
            GsbaError: the name was taken meanwhile.
        """
        done, drop = self._arrived == self.drop.size, self.drop
        if done:
            with disk_errors(drop.final):
                os.fsync(self._file)
                time_ns = drop.modified * 10**6
                os.utime(self._file, ns=(time_ns, time_ns))
                if drop.final.exists():
                    raise GsbaError(f"{drop.name} was written meanwhile: drop it again")
                drop.part.rename(drop.final)
        return {"offset": self._arrived, "done": done}

    def close(self) -> None:
        """Let other pages send the file; what has arrived stays."""
        os.close(self._file)


def unfinished(folder: Path) -> list[dict[str, Any]]:
    """Dropped files of a folder that have arrived in part: "name", "size", "offset", "part"."""
    found = []
    for path in sorted(folder.iterdir()):
        match = _PART.match(path.name)
        if match and path.is_file():
            size, offset = int(match["size"]), path.stat().st_size
            found.append({"name": match["name"], "size": size, "offset": offset, "part": path.name})
    return found


def discard(root: Path, folder: str, part: str) -> None:
    """Delete what has arrived of a dropped file. Raises GsbaError: there is no such file, or it is
    still being sent."""
    path = inside(root, folder) / part
    if "/" in part or not _PART.match(part) or path.is_symlink() or not path.is_file():
        raise GsbaError(f"{brief(part)} is no unfinished drop")
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise GsbaError("it is being sent by another page") from None
        path.unlink(missing_ok=True)


def _placed(
    root: Path,
    target: Path,
    one: Any,
    promised: dict[Path, Drop],
    on_their_way: Callable[[Path], list[dict[str, Any]]],
) -> tuple[Drop, bool]:
    """A dropped file under its name or the first free one; True if that is not its own name."""
    try:
        name, size, modified = str(one["name"]), int(one["size"]), int(one["modified"])
    except (KeyError, TypeError, ValueError):
        raise GsbaError("a dropped file has a name, a size and a time") from None
    parts = _cleaned(name)
    _refuse_other_files(parts[-1])
    if size <= 0 or modified < 0:
        raise GsbaError(f"{brief(parts[-1])} is empty: copy it from the camera again")
    folder = _target(root, (target / "/".join(parts[:-1])).relative_to(root.resolve()).as_posix())
    wish = Path(parts[-1])
    for number in range(1, _MAX_NAMES):
        tried = wish.name if number == 1 else f"{wish.stem}-{number}{wish.suffix}"
        drop = Drop(folder, tried, size, modified)
        parts = {part["part"] for part in on_their_way(folder) if part["name"] == tried}
        of_another = parts - {drop.part.name}
        taken = drop.final.exists() or drop.final in promised or bool(of_another)
        if drop.is_here or not taken:
            return drop, number > 1
    raise GsbaError(f"{brief(wish.name)}: there are {_MAX_NAMES} files of this name: rename it")


def _target(root: Path, folder: str) -> Path:
    """Folder of a drop below the root."""
    path, base = inside(root, folder), root.resolve()
    for each in (path, *path.parents):
        if is_run_folder(each):
            raise GsbaError(f"{each.name} is a run: choose another folder for footage")
        if each == base:
            return path
        if each.exists() and not each.is_dir():
            raise GsbaError(f"{each.name} is a file: choose another folder for footage")
    return path


def _cleaned(name: str) -> list[str]:
    """Components of a dropped path that any disk takes: no controls, no hidden or endless names."""
    if holds_half_characters(name):
        raise GsbaError("the name of a dropped file holds half characters: rename it")
    parts = []
    for part in unicodedata.normalize("NFC", name).split("/"):
        clean = _FORBIDDEN.sub("_", part).strip().lstrip(".-").rstrip(". ")
        stem, dot, suffix = clean.rpartition(".")
        room = _MAX_NAME - len((dot + suffix).encode())
        if len(clean.encode()) > _MAX_NAME:
            clean = stem.encode()[: max(room, 1)].decode("utf-8", "ignore") + dot + suffix
            clean = clean.encode()[:_MAX_NAME].decode("utf-8", "ignore")
        if clean:
            parts.append(clean)
    if not parts or len(parts) > _MAX_DEPTH:
        raise GsbaError(
            f"{brief(name) or 'a dropped file'} has no name that can be used: rename it"
        )
    return parts


def _refuse_other_files(name: str) -> None:
    """Refuse what no command reads, by its suffix."""
    known = {*VIDEO_SUFFIXES, *IMAGE_SUFFIXES, *_BESIDE}
    if Path(name).suffix.lower() not in known or name.lower() == MARKER:
        videos = " ".join(sorted(VIDEO_SUFFIXES))
        raise GsbaError(
            f"{brief(name)} is no footage: drop videos ({videos}), images or folders of images, "
            f"or files beside them ({' '.join(_BESIDE)})"
        )


def _no_room(drop: Drop, left: int, free: int) -> str:
    """Line about a disk that is too small."""
    missing, arrived = max(left - free, 1), drop.arrived
    kept = f"; {100 * arrived // drop.size} % of it is kept" if arrived else ""
    return (
        f"the disk is full: {drop.name} needs {_size(left)} more, and {_size(max(free, 0))} can be "
        f"used: free {_size(missing)}, then drop it again{kept}"
    )


def _size(num: float) -> str:
    """Bytes in GB, or in whole MB, rounded up."""
    return f"{num / 1e9:.1f} GB" if num >= 1e9 else f"{math.ceil(num / 1e6)} MB"
