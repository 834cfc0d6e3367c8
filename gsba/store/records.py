"""Records on disk: one uncompressed `.npz` per record, checked against a type, never pickled.

A record is any value built from numpy arrays, numbers, strings, paths, enums, None, tuples, string
mappings and dataclasses of these. Arrays are members named after their place in the record, at
multiples of 64 bytes so that they are used where they lie; the rest is JSON in `manifest.json`.
"""

import io
import json
import logging
import math
import mmap
import os
import re
import struct
import time
import tokenize
import types
import typing
import zipfile
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Literal, TypeVar, Union, get_args, get_origin

import numpy as np

from gsba.disk import atomic_write
from gsba.memory import mapped_file, release_mapped_files

T = TypeVar("T")

logger = logging.getLogger(__name__)

FORMAT = 1  # raised whenever the layout below changes
HEADER_ERRORS = (SyntaxError, tokenize.TokenError, RecursionError)  # of a damaged .npy or JSON
_MANIFEST = "manifest.json"
_ALIGNMENT = 64  # bytes, of arrays in a file: that of .npy headers
_LOCAL_HEADER = 30  # bytes of a member before its name
_BYTES_AT_ONCE = 1 << 22  # that are checked, of an array that stays on the disk
MIN_MAPPED_BYTES = 1 << 22  # of arrays that are worth a mapping
_HEADER = re.compile(
    rb"\{'descr': '([<>|][biuf]\d+)', 'fortran_order': (True|False), 'shape': \(([\d, ]*)\), \}\s*"
)


class RecordError(Exception):
    """A stored record that is damaged or is not of the expected type."""


def save_record(path: Path, value: object, info: Mapping[str, Any]) -> None:
    """Store a record atomically, with a JSON-able `info` (key, timing); TypeError if it holds a
    type that records cannot hold, GsbaError if the disk cannot be written."""
    arrays: dict[str, np.ndarray] = {}
    manifest = {"format": FORMAT, "info": dict(info), "value": _encode(value, "", arrays)}

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(_MANIFEST, json.dumps(manifest))
            for name, array in arrays.items():
                with archive.open(_aligned(name, archive), "w", force_zip64=True) as member:
                    _write_array(member, array)

    atomic_write(path, write)


def _write_array(member: IO[bytes], array: np.ndarray) -> None:
    """Write an array as `.npy`; pages of one that lies on the disk are held a few at a time."""
    plain = array.flags.c_contiguous and not array.dtype.hasobject
    if array.nbytes < MIN_MAPPED_BYTES or not plain:
        np.lib.format.write_array(member, array, allow_pickle=False)
        return
    np.lib.format.write_array_header_1_0(member, np.lib.format.header_data_from_array_1_0(array))
    content = array.reshape(-1).view(np.uint8).data
    for first in range(0, len(content), _BYTES_AT_ONCE):
        member.write(content[first : first + _BYTES_AT_ONCE])
        release_mapped_files()


def _aligned(name: str, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    """Next member of an archive that is being written, which begins at a multiple of 64 bytes."""
    assert archive.fp is not None
    # The header ends with 20 bytes of sizes (ZIP64) and the padding's own 4.
    header = _LOCAL_HEADER + len(name.encode()) + 20 + 4
    missing = -(archive.fp.tell() + header) % _ALIGNMENT
    member = zipfile.ZipInfo(name, date_time=time.localtime()[:6])
    # the extra field that zip files are aligned by
    member.extra = struct.pack("<HH", 0xD935, missing) + bytes(missing)
    member.external_attr = 0o600 << 16
    return member


def read_info(path: Path) -> dict[str, Any]:
    """The `info` that a record was saved with; RecordError if it cannot be read."""
    with _reading(path) as archive:
        info = _manifest(archive)["info"]
        _require(isinstance(info, dict), info, dict)
        return info


def load_record(path: Path, returns: type[T], mapped: bool = False) -> T:
    """Read a record back as a type, e.g. a dataclass or `tuple[Matches, Counts]`; `mapped` leaves
    large arrays on the disk, read-only, whose file may be replaced, but not changed. RecordError if
    it is missing, corrupt, or of another type."""
    with _reading(path, _MappedArchive if mapped else _Archive) as archive:
        return _decode(_manifest(archive)["value"], returns, archive)


def load_keyed(path: Path, key: str, returns: type[T]) -> T | None:
    """Read a record back if its info has this `key`; None if it has another; see `load_record`."""
    with _reading(path) as archive:
        manifest = _manifest(archive)
        if manifest["info"].get("key") != key:
            return None
        return _decode(manifest["value"], returns, archive)


def load_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Arrays of a record by names of fields, whatever its type: the first of each, in the order of
    the record's fields, without those it lacks; RecordError if damaged."""
    arrays: dict[str, np.ndarray] = {}
    with _reading(path) as archive:
        for member in archive.namelist():
            name = member.rpartition("/")[2].removesuffix(".npy")
            if name in names and name not in arrays:
                arrays[name] = _decode(member, np.ndarray, archive)
    return arrays


def load_checkpoint(path: Path | None, key: str, returns: type[T], anew: str) -> T | None:
    """Record that interrupted work saved with this `key`; None if there is nothing usable, which
    the log tells with the clause `anew`, as "training starts anew"."""
    if path is None or not path.exists():
        return None
    try:
        found = load_keyed(path, key, returns)
        if found is not None:
            return found
        logger.info("%s was made with other inputs or settings: %s", path, anew)
    except RecordError as error:
        logger.warning("%s: %s", anew, error)
    return None


class _Archive(zipfile.ZipFile):
    """Archive whose arrays are read as a whole."""

    def array(self, name: str) -> np.ndarray:
        """An array of numbers whose bytes agree with their checksum and header; else ValueError."""
        content = self.read(name)
        file = io.BytesIO(content)
        shape, fortran, dtype = _header(file)
        if len(content) != file.tell() + math.prod(shape) * dtype.itemsize:
            raise ValueError(f"{name} is longer or shorter than its header says")
        flat = np.frombuffer(content, dtype, offset=file.tell()).copy()
        return flat.reshape(shape, order="F" if fortran else "C")


class _MappedArchive(_Archive):
    """Archive whose large arrays are used where they lie."""

    _content: mmap.mmap | None = None

    def array(self, name: str) -> np.ndarray:
        """As that of any archive; small ones are read, and those of files that did not align
        them."""
        member = self.getinfo(name)
        mapped = self._mapped(member) if member.file_size >= MIN_MAPPED_BYTES else None
        return super().array(name) if mapped is None else mapped

    def _mapped(self, member: zipfile.ZipInfo) -> np.ndarray | None:
        """An array in its place; None = it is not aligned there."""
        with self.open(member) as file:
            shape, fortran, dtype = _header(file)
            header = file.tell()
            while file.read(_BYTES_AT_ONCE):  # compared with the checksum at the end
                pass
        if self._content is None:
            assert self.fp is not None
            self._content = mapped_file(self.fp)
        first = member.header_offset
        name_bytes, extra = struct.unpack_from("<HH", self._content, first + 26)
        first += _LOCAL_HEADER + name_bytes + extra + header
        if first % _ALIGNMENT or member.file_size != header + math.prod(shape) * dtype.itemsize:
            return None
        flat = np.frombuffer(self._content, dtype, math.prod(shape), first)
        return flat.reshape(shape, order="F" if fortran else "C")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type of an array of numbers, from the beginning of its `.npy` file.

    numpy's reader parses the header as Python code: one thread at a time, and CPython 3.11 fails at
    times where another one parses, too (its issue 106905).
    """
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"an array of version {version}")
    found = _HEADER.fullmatch(file.read(int.from_bytes(file.read(2), "little")))
    if found is None:
        raise ValueError("not the header of an array of numbers")
    kind, fortran, sizes = (part.decode() for part in found.groups())
    shape = tuple(int(size) for size in sizes.split(",") if size.strip())
    return shape, fortran == "True", np.dtype(kind)


@contextmanager
def _reading(path: Path, archive_type: "type[_Archive]" = _Archive) -> Iterator[_Archive]:
    try:
        with archive_type(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise ValueError("it is compressed, which no record is: it may unpack to any size")
            yield archive
    except (OSError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise RecordError(f"{path}: {error}") from error  # trees and arrays of another shape
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, *HEADER_ERRORS) as error:
        raise RecordError(f"{path}: {error}") from error  # damaged archives


def _manifest(archive: _Archive) -> dict[str, Any]:
    manifest = json.loads(archive.read(_MANIFEST))
    if manifest["format"] != FORMAT:
        raise RecordError(f"{archive.filename}: format {manifest['format']}, expected {FORMAT}")
    return manifest


def _encode(value: object, place: str, arrays: dict[str, np.ndarray]) -> Any:
    """JSON tree of `value`, in which arrays are names of members; the arrays go to `arrays`."""
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        name = f"{place or 'array'}.npy"
        arrays[name] = value
        return name
    if is_dataclass(value) and not isinstance(value, type):
        items = {entry.name: getattr(value, entry.name) for entry in fields(value)}
    elif isinstance(value, Mapping):
        items = dict(value)
        if not all(isinstance(name, str) for name in items):
            raise TypeError(f"record field {place}: only string keys can be stored")
    elif isinstance(value, tuple | list):
        return [_encode(item, _join(place, str(i)), arrays) for i, item in enumerate(value)]
    else:
        raise TypeError(f"record field {place or '.'}: cannot store a {type(value).__name__}")
    return {name: _encode(item, _join(place, name), arrays) for name, item in items.items()}


def _join(place: str, name: str) -> str:
    return f"{place}/{name}" if place else name


def typed(tree: Any, returns: type[T]) -> T:
    """Record without arrays from its JSON tree; RecordError if it is of another type."""
    try:
        return _decode(tree, returns, None)
    except (ValueError, TypeError, AttributeError) as error:
        raise RecordError(str(error)) from error


def _decode(tree: Any, hint: Any, archive: _Archive | None) -> Any:
    """Value of type `hint` from its JSON tree; RecordError if the tree is of another type."""
    origin = get_origin(hint)
    if archive is not None and (hint is np.ndarray or origin is np.ndarray):
        return archive.array(tree)
    if origin in (Union, types.UnionType):
        return _decode_union(tree, get_args(hint), archive)
    if origin in (tuple, list):
        _require(isinstance(tree, list), tree, hint)
        items = get_args(hint)
        if get_origin(hint) is list:
            return [_decode(value, items[0], archive) for value in tree]
        if len(items) == 2 and items[1] is Ellipsis:
            items = (items[0],) * len(tree)
        _require(len(items) == len(tree), tree, hint)
        return tuple(_decode(value, item, archive) for value, item in zip(tree, items, strict=True))
    if origin is not None and origin is not Literal and issubclass(origin, Mapping):
        _require(isinstance(tree, dict), tree, hint)
        item = get_args(hint)[1]
        return {name: _decode(value, item, archive) for name, value in tree.items()}
    if is_dataclass(hint) and isinstance(hint, type):
        needed, hints = _fields_of(hint)
        if not isinstance(tree, dict) or not needed <= set(tree) <= set(hints):
            where = f"{archive.filename}: " if archive is not None else ""
            raise RecordError(f"{where}not a {hint.__name__} of this version")
        return hint(**{name: _decode(value, hints[name], archive) for name, value in tree.items()})
    if get_origin(hint) is Literal:
        _require(tree in get_args(hint), tree, hint)
        return tree
    if hint is None or hint is type(None):
        _require(tree is None, tree, hint)
        return None
    if hint is float:
        _require(isinstance(tree, int | float) and not isinstance(tree, bool), tree, hint)
        return float(tree)
    if hint in (bool, int, str):
        _require(type(tree) is hint, tree, hint)
        return tree
    if hint is Path:
        _require(isinstance(tree, str) and b"\0" not in os.fsencode(tree), tree, hint)
        return Path(tree)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(tree)
    raise TypeError(f"records cannot hold {hint}")


def _decode_union(tree: Any, hints: tuple[Any, ...], archive: _Archive | None) -> Any:
    if tree is None and type(None) in hints:
        return None
    for hint in hints:
        if hint is not type(None):
            try:
                return _decode(tree, hint, archive)
            except (RecordError, ValueError):
                continue
    raise RecordError(f"{tree!r:.60} is none of {hints}")


@lru_cache(maxsize=256)
def _fields_of(cls: type) -> tuple[frozenset[str], dict[str, Any]]:
    """Names of a dataclass's fields that have no default, and the types of all."""
    own, hints = fields(cls), typing.get_type_hints(cls)
    # Records from before a field with a default was added can be read.
    needed = [f.name for f in own if f.default is MISSING and f.default_factory is MISSING]
    return frozenset(needed), {entry.name: hints[entry.name] for entry in own}


def _require(condition: bool, tree: Any, hint: Any) -> None:
    if not condition:
        raise RecordError(f"{tree!r:.60} is no {hint}")
