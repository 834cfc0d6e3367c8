"""Atomic writing of files, arrays on the disk, locks on folders, and disk errors in one line."""

import csv
import ctypes
import errno
import fcntl
import json
import logging
import os
import shutil
import sys
import tempfile
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING

from gsba.log import GsbaError
from gsba.memory import mapped_file

if TYPE_CHECKING:
    import numpy as np

logger = logging.getLogger(__name__)

_TEMPORARY = ".gsba-tmp-"  # prefix of files still being written
_AT_FDCWD, _RENAME_EXCHANGE, _RENAME_SWAP_DARWIN = -100, 2, 2  # of renameat2 and renamex_np


class FullDiskError(GsbaError):
    """No space is left on the disk."""


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn an OSError of writing to `path` into one line with the remedy."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise FullDiskError(
                f"no space left while writing {path}: free some and run again"
            ) from error
        raise GsbaError(f"cannot write {path}: {error.strerror or error}") from error


def atomic_write(path: Path, write: Callable[[Path], object], parents: bool = True) -> None:
    """Write a file beside `path`, by `write` with a temporary path of the same folder and suffix,
    and rename it into place, so that `path` is never half-written; GsbaError if the disk is
    full."""
    # Processes of several machines may write the same file at the same time.
    temporary = path.with_name(f"{_TEMPORARY}{uuid.uuid4().hex[:8]}-{path.name}")
    with disk_errors(path):
        if parents:
            path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write(temporary)
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)


def with_own_name(path: Path) -> Path:
    """The path of a file or folder, absolute where it ends without a name, as `.` and `..` do."""
    return path if path.name not in ("", "..") else Path(os.path.abspath(path))


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, atomically; see `atomic_write`."""
    atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_bytes(path: Path, content: bytes, parents: bool = True) -> None:
    """Write a file's content atomically; see `atomic_write`."""
    atomic_write(path, lambda temporary: temporary.write_bytes(content), parents)


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a table as CSV, atomically; see `atomic_write`."""

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([header, *rows])

    atomic_write(path, write)


def write_json(path: Path, content: object) -> None:
    """Write plain values as JSON with finite numbers, atomically; see `atomic_write`."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_image(path: Path, image: "np.ndarray", jpeg_quality: int = 95) -> None:
    """Encode (H, W, 3) RGB or (H, W) uint8 by the suffix of `path`, atomically."""
    write_bytes(path, encoded_image(image, path, jpeg_quality))


def encoded_image(image: "np.ndarray", path: Path, jpeg_quality: int = 95) -> bytes:
    """Content of an image file with this suffix, of (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) uint8;
    GsbaError if it cannot be encoded so."""
    import cv2

    options = [] if path.suffix.lower() == ".png" else [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    orders = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    pixels = cv2.cvtColor(image, orders[image.shape[2]]) if image.ndim == 3 else image
    done, encoded = cv2.imencode(path.suffix, pixels, options)
    if not done:
        height, width = image.shape[:2]
        raise GsbaError(f"{path}: OpenCV cannot encode {width}x{height} pixels as {path.suffix}")
    return encoded.tobytes()


def write_vertices(path: Path, vertices: "np.ndarray") -> None:
    """Write a binary little-endian PLY file with one element, `vertex`, atomically: (N,)
    structured, a field for each property, in the file's order."""
    from plyfile import PlyData, PlyElement

    file = PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<")
    atomic_write(path, lambda temporary: file.write(str(temporary)))


def read_vertices(path: Path) -> "np.ndarray":
    """The element `vertex` of a binary or ASCII PLY file, (N,) structured, a field for each
    property, mapped from a binary file; GsbaError if it is damaged, or its points have lists."""
    from plyfile import PlyData, PlyHeaderParseError

    try:
        file = PlyData.read(str(path))
    except (PlyHeaderParseError, UnicodeDecodeError) as error:
        raise GsbaError(f"{path}: not a PLY file, or its header is damaged ({error})") from None
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception:  # the parser raises errors of many types
        raise GsbaError(
            f"{path}: truncated or damaged: it holds fewer points than its header claims; copy or "
            "export it again"
        ) from None
    if "vertex" not in file:
        raise GsbaError(f"{path}: holds no points: it has no element 'vertex'")
    vertices = file["vertex"].data
    if vertices.dtype.hasobject:
        raise GsbaError(f"{path}: a property of its points is a list")
    return vertices


def link_or_copy(source: Path, target: Path) -> None:
    """Give a file a second name, which it replaces, or copy it where the disk knows no hard
    links."""

    def write(temporary: Path) -> None:
        try:
            os.link(source, temporary)
        except OSError:  # another disk, or a file system without links
            shutil.copyfile(source, temporary)

    atomic_write(target, write)


def exchange_folders(one: Path, other: Path) -> bool:
    """Exchange two folders of one disk in a single step, so that either is there at any moment;
    False where the system cannot: nothing was changed."""
    library = ctypes.CDLL(None, use_errno=True)
    if sys.platform == "darwin":
        names = os.fsencode(one), os.fsencode(other)
        return library.renamex_np(*names, _RENAME_SWAP_DARWIN) == 0
    try:
        rename = library.renameat2
    except AttributeError:  # a C library without it
        return False
    return rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), _RENAME_EXCHANGE) == 0


def remove_temporaries(folder: Path) -> None:
    """Delete temporary files that killed processes left under `folder`."""
    for path in folder.rglob(f"{_TEMPORARY}*"):
        path.unlink(missing_ok=True)


def refuse_links(folder: Path, below: bool = False) -> None:
    """Refuse a folder to write to, which may be missing, if it or (with `below`) what is in it
    holds a link, pipe or device: through links, gsba would replace files elsewhere."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise _not_ours(folder)
    waiting = [folder] if folder.exists() else []
    with disk_errors(folder):
        while waiting:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting += [Path(entry.path)] if below else []
                    elif not entry.is_file(follow_symlinks=False):
                        raise _not_ours(Path(entry.path))


def _not_ours(path: Path) -> GsbaError:
    kind = "a link" if path.is_symlink() else "no folder, or no ordinary file,"
    return GsbaError(
        f"{path} is {kind} where gsba keeps its own files: move it away, or use another folder"
    )


def hold_folder(folder: Path) -> int:
    """Lock a folder against other processes until the descriptor returned is closed or this process
    ends: the kernel keeps the lock, so it is never stale. GsbaError if another one holds it."""
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise GsbaError(
            f"{folder} is in use by another gsba process: wait for it to end"
        ) from error
    except OSError as error:  # some network file systems cannot lock
        logger.warning("%s cannot be locked (%s): let no second process use it", folder, error)
    return lock


def remove_unheld(folders: Iterable[Path]) -> None:
    """Delete folders that no process has locked, see `hold_folder`."""
    for folder in folders:
        with suppress(OSError):
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(lock)


def concatenated(
    parts: "Iterable[Sequence[np.ndarray]]", folder: Path | None
) -> "list[np.ndarray]":
    """Rows of all parts, back to back, in files without a name that end with the arrays.

    Args:
        parts: at least one, each of C arrays (N, ...); types and shapes of rows are those of the
            first part.
        folder: on the disk that takes the files, made if missing; None = arrays are in memory.

    Returns:
        C arrays, read-only, whose pages are read as they are used.

    Raises:
        GsbaError: the disk cannot be written.
    """
    import numpy as np

    if folder is None:
        return [np.concatenate(column) for column in zip(*parts, strict=True)]
    parts = iter(parts)
    first = next(parts)
    with ExitStack() as stack:
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            files = [stack.enter_context(tempfile.TemporaryFile(dir=folder)) for _ in first]
        for arrays in chain([first], parts):
            with disk_errors(folder):
                for file, array, like in zip(files, arrays, first, strict=True):
                    file.write(np.ascontiguousarray(array, like.dtype).data)
        with disk_errors(folder):
            for file in files:
                file.flush()
        return [_mapped(file, like) for file, like in zip(files, first, strict=True)]


def _mapped(file: IO[bytes], like: "np.ndarray") -> "np.ndarray":
    """Array (N, ...) of a file's content, rows shaped like those of another one."""
    import numpy as np

    if not file.tell():
        return like[:0].copy()
    return np.frombuffer(mapped_file(file), like.dtype).reshape(-1, *like.shape[1:])
