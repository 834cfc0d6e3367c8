"""Damage to the inputs of `fuzz.py`: a case under construction, and the ways to change a file."""

import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

WORDS = (
    *("nan", "inf", "-inf", "1e309", "1e-320", "1e155", "-1e300", "", "0", "-0", "-1", "9" * 5000),
    *("null", "none", "true", "é", "\ufeff", "1,5", "[", "]", '"', "\n", "\\", "0x10", "../.."),
    *("1_0", "1e18", "1e-9", "٣", "-1e-5", "1e9", "/", "/dev/null", "a" * 130_000, "%s"),
)
TREES: tuple[Any, ...] = (
    *(None, [], {}, 3, -1, 0.5, 1e308, True, "x", "", 10**400, [None], [[1]], {"a": 1}, ["x"]),
)
_UNFINISHED = ("gsba.json", "stages", "masks", "frames", "extract.json", "extract.partial.csv")


@dataclass(frozen=True)
class Spoiled:
    """Case: its files, its command, and the check of its output."""

    family: str
    what: str
    arguments: list[str]
    make: Callable[[Path, Path], None]  # (prepared folder, empty folder): makes its files
    check: Callable[[Path, Any], str | None]  # (folder, result) -> fault; None = none
    limit_s: float = 30.0
    resumes: bool = False  # a next call uses the output left after a failure

    def keeps(self, path: Path) -> bool:
        """True if a file must not change when the call fails."""
        return "out" not in path.parts

    def finished(self, path: Path) -> bool:
        """True if a file in the output folder belongs to finished output only."""
        unfinished = path.parts[0] in _UNFINISHED or path.suffix == ".jpg"  # of a video, so far
        return not (self.resumes and unfinished)


@dataclass
class Draft:
    """Case under construction; its steps in order become `make`."""

    rng: np.random.Generator
    arguments: list[str] = field(default_factory=list)
    steps: list[Callable[[Path, Path], None]] = field(default_factory=list)
    changes: list[str] = field(default_factory=list)

    def pick(self, options: Sequence[Any]) -> Any:
        return options[int(self.rng.integers(len(options)))]

    def copy(self, *names: str) -> None:
        """Copy prepared files or folders."""
        for name in names:
            self.steps.append(lambda source, here, name=name: copied(source / name, here / name))

    def edit(self, name: str, change: Callable[[bytes], bytes], what: str) -> None:
        self.changes.append(f"{name} {what}")

        def step(_: Path, here: Path) -> None:
            path = here / name
            path.write_bytes(change(path.read_bytes()))

        self.steps.append(step)

    def done(self, family: str, check: Callable[[Path, Any], str | None], **more: Any) -> Spoiled:
        steps = list(self.steps)

        def make(source: Path, here: Path) -> None:
            for step in steps:
                step(source, here)

        what = ", ".join(self.changes) or "undamaged"
        return Spoiled(family, what[:200], self.arguments, make, check, **more)


def spoil_file(
    draft: Draft, name: str, how: Callable[[Draft], Callable[[bytes], bytes]] | None = None
) -> None:
    """Damage a table or a binary file in a random or the given way."""
    ways = [change_bytes, change_word, change_word, change_lines, change_columns, change_encoding]
    if name.endswith((".msg", ".png")):
        ways = [change_bytes]
    chosen = how or draft.pick(ways)
    draft.edit(name, chosen(draft), chosen.__name__.removeprefix("change_"))


def change_bytes(draft: Draft) -> Callable[[bytes], bytes]:
    """Flip, cut, repeat, blank or insert some bytes."""
    how, at, long = int(draft.rng.integers(6)), draft.rng.random(), int(draft.rng.integers(1, 200))
    noise = draft.rng.bytes(long)
    flips = draft.rng.random(int(draft.rng.integers(1, 20)))

    def change(data: bytes) -> bytes:
        start = int(at * len(data))
        if how == 0:
            spoiled = bytearray(data)
            for f in flips[: len(data)]:
                spoiled[int(f * len(data))] ^= 1 << int(97 * f) % 8
            return bytes(spoiled)
        middle = [data[start : start + long] * 3, b"", b"\0" * long, noise, b""][how - 1]
        return data[:start] + middle + (b"" if how == 2 else data[start + long :])

    return change


def change_word(draft: Draft) -> Callable[[bytes], bytes]:
    """Replace a word by an unusual one."""
    at, word = draft.rng.random(2), draft.pick([*WORDS, "\x00", "a" * 140_000])

    def change(data: bytes) -> bytes:
        lines = data.decode("utf-8", "replace").split("\n")
        line = int(at[0] * len(lines))
        separator = "," if "," in lines[line] else " "
        cells = lines[line].split(separator)
        cells[int(at[1] * len(cells))] = word
        lines[line] = separator.join(cells)
        return "\n".join(lines).encode("utf-8", "replace")

    return change


def change_lines(draft: Draft) -> Callable[[bytes], bytes]:
    """Drop, repeat, shuffle or reverse lines."""
    how, at = int(draft.rng.integers(6)), draft.rng.random(2)
    order = draft.rng.permutation(400)

    def change(data: bytes) -> bytes:
        lines = data.splitlines(keepends=True)
        a, b = sorted(int(x * len(lines)) for x in at)
        ways = [
            lambda: lines[:a] + lines[b:],
            lambda: lines[:a] + lines[a:b] * 2 + lines[b:],
            lambda: [lines[i] for i in order if i < len(lines)],
            lambda: lines[::-1],
            lambda: lines[a : a + 1],
            lambda: lines[:1] * len(lines),
        ]
        return b"".join(ways[how]())

    return change


def change_columns(draft: Draft) -> Callable[[bytes], bytes]:
    """Scale or shift a column of numbers, or exchange two."""
    factor = draft.pick([1e3, 1e6, 1e9, 1e-3, 1e-9, 1e150, 1e-150, -1.0, 0.0, 1e15, 1e-6, 10.0])
    shift = draft.pick([0.0, 0.0, 1e9, 1e16, -1e3, 0.25, 3.0])
    column, other, swap = *draft.rng.integers(0, 8, 2), draft.rng.random() < 0.2
    several = draft.rng.random() < 0.3

    def change(data: bytes) -> bytes:
        out = []
        for line in data.decode("utf-8", "replace").split("\n"):
            separator = "," if "," in line else " "
            cells = line.split(separator)
            c, d = int(column) % len(cells), int(other) % len(cells)
            if swap:
                cells[c], cells[d] = cells[d], cells[c]
            for k in (1, 2, 3) if several and len(cells) == 8 else (c,):
                try:
                    cells[k] = repr(float(cells[k]) * factor + shift)
                except ValueError:
                    continue
            out.append(separator.join(cells))
        return "\n".join(out).encode("utf-8", "replace")

    return change


def change_encoding(draft: Draft) -> Callable[[bytes], bytes]:
    """Change the encoding, the line ends or the separators."""
    ways: list[Callable[[str], bytes]] = [
        lambda text: text.encode("utf-16"),
        lambda text: text.encode("utf-32"),
        lambda text: text.encode("utf-8-sig"),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: text.replace("\n", "\r").encode(),
        lambda text: text.replace(" ", "\t").encode(),
        lambda text: text.replace(" ", ",").encode(),
        lambda text: text.replace(",", ";").encode(),
        lambda text: text.replace('"UTF-8"', '"utf-32"').encode(),
        lambda text: text.replace('"UTF-8"', '"x-none"').encode(),
        lambda text: (text + "\n" * 9).encode(),
    ]
    way = draft.pick(ways)
    return lambda data: way(data.decode("utf-8", "replace"))


def change_tree(draft: Draft) -> Callable[[bytes], bytes]:
    """Replace a random value of a JSON tree by an unusual one."""
    value, turns = draft.pick(TREES), draft.rng.random(6)

    def change(data: bytes) -> bytes:
        whole = [json.loads(data)]
        node: Any = whole
        key: Any = 0
        for turn in turns:
            inner = node[key]
            if not isinstance(inner, dict | list) or not inner or turn < 0.15:
                break
            keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
            node, key = inner, keys[int(turn * 997) % len(keys)]
        node[key] = value
        return json.dumps(whole[0]).encode()

    return change


def change_array(draft: Draft) -> Callable[[bytes], bytes]:
    """Replace an array by one of another shape, type or values."""
    how, at = int(draft.rng.integers(11)), draft.rng.random()

    def change(data: bytes) -> bytes:
        array = np.lib.format.read_array(io.BytesIO(data))
        flat = array.reshape(-1).copy()
        value = [np.nan, np.inf, 1e300, -1.0, 0.0][int(at * 5)]
        if how < 4 and len(flat) and array.dtype.kind == "f":
            flat[int(at * len(flat))] = value
        elif how < 4 and len(flat):
            flat[int(at * len(flat))] = 1 if array.dtype.kind == "b" else 120
        spoiled: dict[int, Callable[[], np.ndarray]] = {
            4: lambda: array[:-1] if array.ndim else array,
            5: lambda: array.reshape(-1),
            6: lambda: np.full_like(array, value if array.dtype.kind == "f" else 99),
            7: lambda: array.astype(np.complex128),
            8: lambda: array.astype(str),
            9: lambda: np.zeros((0, 0)),
            10: lambda: np.array(value),
        }
        file = io.BytesIO()
        np.lib.format.write_array(file, spoiled.get(how, lambda: flat.reshape(array.shape))())
        return file.getvalue()

    return change


def change_member(
    draft: Draft, name: str | None, change: Callable[[bytes], bytes]
) -> Callable[[bytes], bytes]:
    """Change one member of a zip archive; None = any array."""
    at = draft.rng.random()

    def changed(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {entry: archive.read(entry) for entry in archive.namelist()}
        arrays = sorted(entry for entry in members if entry.endswith(".npy"))
        chosen = name or arrays[int(at * len(arrays))]
        members[chosen] = change(members[chosen])
        file = io.BytesIO()
        with zipfile.ZipFile(file, "w") as archive:
            for entry, content in members.items():
                archive.writestr(entry, content)
        return file.getvalue()

    return changed


def spoil_names(draft: Draft, folder: str) -> None:
    """Rename, add or remove files of a folder of frames."""
    how = int(draft.rng.integers(6))
    odd = draft.pick([b"\xff.jpg", b"a\n.jpg", b"..jpg", b"x_front.jpg", b"9" * 200 + b".jpg"])
    draft.changes.append(f"{folder}: names {how} {odd!r:.30}")

    def step(_: Path, here: Path) -> None:
        files = sorted((here / folder).iterdir())
        if how == 0:
            files[0].rename(here / folder / os.fsdecode(odd))
        elif how == 1:
            shutil.copy(files[0], files[0].with_suffix(".png"))
        elif how == 2:
            files[1].unlink()
        elif how == 3:
            files[0].with_name("timestamps.csv").write_text("name,timestamp\n0,1\n")
        elif how == 4:
            (here / folder / "front").mkdir()
            shutil.copy(files[0], here / folder / "front")
        else:
            for file in files:
                file.unlink()

    draft.steps.append(step)


def copied(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target, dirs_exist_ok=True)
    else:
        shutil.copy(source, target)


def written(path: Path, data: bytes) -> None:
    """Write a file; a statement for lambdas."""
    path.write_bytes(data)
