"""Inputs and cases of `fuzz.py`: inputs are made once, and each number gives a damaged case."""

import csv
import io
import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsba.config import RefineSettings
from gsba.demo.degrade import degrade
from gsba.demo.gallery import build_gallery
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.similarity import pose_similarity
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

NUM, WIDTH = 8, 512  # frames of the walk
SETTINGS = {
    "cubemap": {"face_size": 256},
    "features": {"max_per_face": 400},
    "patches": {"rounds": 0},
    "export": {"formats": []},
    "solver": {"num_threads": 2},
}
FAMILIES = {  # and how many of a hundred cases each gets
    "settings": 22,
    "trajectories": 16,
    "starts": 14,
    "images": 10,
    "placements": 14,
    "edited runs": 10,
    "depth maps": 5,
    "videos": 4,
    "splats": 3,
    "runs": 2,
}
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


def spoil(number: int, seed: int, family: str | None = None) -> Spoiled:
    """Case `number` of a seed, of one family or of all in their proportions."""
    rng = np.random.default_rng([seed, number])
    names = list(FAMILIES)
    shares = np.array(list(FAMILIES.values())) / sum(FAMILIES.values())
    chosen = str(rng.choice(names, p=shares))
    return DRAWN[family or chosen](Draft(rng))


def _settings(draft: Draft) -> Spoiled:
    """Case of overrides and files of settings, printed and read back."""
    draft.arguments = ["show-config"]
    keys, text = list(_flat(RefineSettings().model_dump())), []
    for _ in range(int(draft.rng.integers(1, 4))):
        key, value = draft.pick(keys)
        key = draft.pick([key, key, key, key.partition(".")[0], key + "x", key + ".x", ""])
        value = draft.pick([*map(json.dumps, (value, -1, 0, [value], {"x": value})), *WORDS, "7"])
        text.append((key, value))
    draft.changes = [f"{key}={value[:40]}" for key, value in text]
    if draft.rng.random() < 0.7:
        for key, value in text:
            draft.arguments += ["--set", f"{key}={value}"]
    else:
        whole = "\n".join(f"{key} = {value}" for key, value in text).encode("utf-8", "replace")
        change = change_bytes(draft) if draft.rng.random() < 0.3 else lambda data: data
        draft.steps.append(lambda _, here: _written(here / "s.toml", change(whole)))
        draft.arguments += ["--config", "s.toml"]
    if draft.rng.random() < 0.15:
        draft.arguments += [
            "--factors",
            draft.pick([*WORDS, "splat", "bearing,,", "bearing,splat"]),
        ]

    def check(here: Path, result: Any) -> str | None:
        from gsba.config_file import load_config, to_toml

        (here / "back.toml").write_text(result.stdout, encoding="utf-8")
        again = to_toml(load_config(here / "back.toml"))
        return None if again == result.stdout else "settings do not read back"

    return draft.done("settings", check)


def _trajectories(draft: Draft) -> Spoiled:
    """Case of poses in every format, read and compared with the truth."""
    name = draft.pick(["slam.tum", "slam.tum", "map.msg"])
    draft.copy(name, "truth.tum")
    spoiled = draft.pick([name, name, name, "truth.tum"])
    spoil_file(draft, spoiled)
    draft.arguments = ["evaluate", name, "--truth", "truth.tum", "--json", "numbers.json"]

    def check(here: Path, _: Any) -> str | None:
        numbers = json.loads((here / "numbers.json").read_text())
        return _not_finite([numbers["scale"], numbers["ate"]]) or (
            None if numbers["scale"] > 0 else "scale"
        )

    return draft.done("trajectories", check)


def _starts(draft: Draft) -> Spoiled:
    """Case of refine on frames without texture, which it should refuse early."""
    draft.copy("flat", "slam.tum", "times.csv", "mask.png", "poses.kitti", "keyframes.tum")
    when = draft.pick([["--fps", "2"], ["--timestamps", "times.csv"], []])
    poses = draft.pick([["slam.tum"], ["slam.tum"], ["poses.kitti"], [], ["slam.tum", "slam.tum"]])
    options = [*when, *(poses or ["--no-trajectory"])]
    how = int(draft.rng.integers(7))
    if how == 0 and poses:
        spoil_file(draft, poses[0])
    elif how == 1:
        options = [*poses, "--timestamps", "times.csv"]
        spoil_file(draft, "times.csv")
    elif how == 2:
        options = [*poses, "--fps", draft.pick([*WORDS, "1e-300", "0.01", "20", "2000", "1e300"])]
    elif how == 3:
        options += ["--masks", draft.pick(["mask.png", "flat", "x", "carrier", "", "slam.tum"])]
        spoil_file(draft, "mask.png")
    elif how == 4 and poses == ["slam.tum"]:
        options += ["--keyframes", "keyframes.tum"]
        spoil_file(draft, "keyframes.tum")
    elif how == 5:
        _spoil_names(draft, "flat")
    else:
        key = draft.pick(["read.clock_offset_s", "seed", "placement.gps", "placement.align"])
        options += ["--set", f"{key}={draft.pick(WORDS)}"]
    draft.arguments = ["--quiet", "refine", "flat", *options, "--out", "out", *small_settings()]
    draft.changes.append(" ".join(options)[:120])
    return draft.done("starts", lambda *_: "frames that show nothing were refined", resumes=True)


def _images(draft: Draft) -> Spoiled:
    """Case of an image with damaged bytes among good ones."""
    draft.copy("noisy", "slam.tum")
    name = draft.pick(["0.jpg", "1.png", "2.jpg"])
    draft.edit(f"noisy/{name}", change_bytes(draft), "bytes")
    gps = ["--set", "placement.gps=exif"] if draft.rng.random() < 0.3 else []
    draft.arguments = ["--quiet", "refine", "noisy", "slam.tum", "--fps", "2", "--out", "out"]
    draft.arguments += [*small_settings(), *gps]
    return draft.done("images", lambda *_: "noise was refined", resumes=True)


def _placements(draft: Draft) -> Spoiled:
    """Case of exports that are placed by damaged tables and extreme options."""
    draft.copy("gps.csv", "track.gpx", "truth.tum")
    way = draft.pick(["gps.csv", "gps.csv", "track.gpx", "truth.tum", "between", "between"])
    numbers = [*WORDS, "1e-200", "3.5", "1e13", "1e-13"]
    if way == "between":
        ends = [
            draft.pick(["000001", "000007", "0,0,0", "1,1,1", f"{draft.pick(numbers)},0,0", "x"])
            for _ in range(2)
        ]
        options = ["--scale", draft.pick([*numbers, "1", "2", "3"]), "--between", *ends]
    else:
        options = ["--align" if way == "truth.tum" else "--gps", way]
        spoil_file(draft, way)
    up = draft.pick([[], [], [], ["--up", draft.pick(["auto", "none", "", "x"])]])
    to = draft.pick(["tum", "tum", "ply", draft.pick(["", "x", "nerfstudio"])])
    size = draft.pick(
        [[], [], ["--face-size", draft.pick(["16", "0", "15", "-1", "1e9", "10000000"])]]
    )
    draft.arguments = ["--quiet", "export", _RUN, "--to", to, "--out", "out", *up, *options, *size]
    draft.changes.append(" ".join([*up, *options])[:120])
    return draft.done("placements", check_export)


def _edited(draft: Draft) -> Spoiled:
    """Case of a finished run with a file that was edited or damaged."""
    draft.copy("light")
    name = draft.pick(
        ["gsba.json", "stages/reconstruction.npz", "stages/frames.npz", "trajectory.tum"]
    )
    how = int(draft.rng.integers(3))
    if name == "trajectory.tum":
        spoil_file(draft, f"light/{name}")
    elif how == 0:
        draft.edit(f"light/{name}", change_bytes(draft), "bytes")
    elif name.endswith(".json"):
        draft.edit(f"light/{name}", change_tree(draft), "tree")
    elif how == 1:
        draft.edit(
            f"light/{name}", change_member(draft, "manifest.json", change_tree(draft)), "manifest"
        )
    else:
        draft.edit(f"light/{name}", change_member(draft, None, _array(draft)), "array")
    if draft.rng.random() < 0.3 or name == "trajectory.tum":
        draft.copy("truth.tum")
        draft.arguments = ["evaluate", "light", "--truth", "truth.tum", "--json", "numbers.json"]
        return draft.done("edited runs", lambda *_: None)
    draft.arguments = ["--quiet", "export", "light", "--to", draft.pick(["tum", "ply"])]
    draft.arguments += ["--out", "out"]
    return draft.done("edited runs", check_export)


def _depths(draft: Draft) -> Spoiled:
    """Case of invalid depth maps."""
    draft.copy("depth", "truth.tum", "slam.tum")
    name = f"depth/{int(draft.rng.integers(NUM)):06d}.npz"
    how = int(draft.rng.integers(4))
    if how == 0:
        draft.edit(name, change_bytes(draft), "bytes")
    elif how == 1:
        draft.edit(name, change_member(draft, None, _array(draft)), "array")
    elif how == 2:
        draft.edit(name, lambda _: draft.pick([b"", b"range", b"\x93NUMPY", b"PK"]), "text")
    else:
        draft.changes.append(f"{name} gone")
        draft.steps.append(lambda _, here: (here / name).unlink())
    draft.arguments = ["evaluate", "slam.tum", "--truth", "truth.tum", "--depth", "depth"]
    draft.arguments += ["--json", "numbers.json"]

    def check(here: Path, _: Any) -> str | None:
        return _not_finite(json.loads((here / "numbers.json").read_text())["induced"])

    return draft.done("depth maps", check)


def _videos(draft: Draft) -> Spoiled:
    """Case of a video with damaged bytes, or of unusual options for its frames."""
    draft.copy("walk.mp4", "slam.tum")
    draft.arguments = ["--quiet", "extract", "walk.mp4", "--out", "out"]
    if draft.rng.random() < 0.7:
        draft.edit("walk.mp4", change_bytes(draft), "bytes")
    numbers = [*WORDS, "0.5", "2", "1e6", "99999"]
    for option in ("--fps", "--every", "--from", "--to", "--width", "--at"):
        if draft.rng.random() < 0.15:
            value = draft.pick(["slam.tum", "x", ""] if option == "--at" else numbers)
            draft.arguments += [option, value]
            draft.changes.append(f"{option} {value[:30]}")

    def check(here: Path, _: Any) -> str | None:
        rows = list(csv.reader(_lines_of(here / "out/timestamps.csv")))[1:]
        times = np.array([float(row[1]) for row in rows])
        if not len(rows) or (np.diff(times) <= 0).any():
            return "times"
        images = [cv2.imread(str(here / "out" / row[0])) for row in rows]
        sizes = {None if image is None else image.shape for image in images}
        return None if len(sizes) == 1 and None not in sizes else f"sizes {sizes}"

    return draft.done("videos", check, resumes=True)


def _splats(draft: Draft) -> Spoiled:
    """Case of rendering a splat from a damaged file."""
    draft.copy("splat.ply")
    if draft.rng.random() < 0.5:
        draft.edit("splat.ply", change_bytes(draft), "bytes")
    else:
        words = [b"property", b"float", b"vertex", b"ply", b"format", b"end_header", b"x"]
        old, new = draft.pick(words), draft.pick([b"", b"double", b"nan", b"-1", b"9" * 50])
        draft.edit("splat.ply", lambda data: data.replace(old, new, 1), f"{old} is {new}")
    frame = draft.pick(["000001", "000001", "x", ""])
    draft.arguments = ["--quiet", "render", "splat.ply", _RUN, "--frame", frame, "--out", "out"]
    draft.arguments += ["--face-size", "16", "--backend", "cpu"]

    def check(here: Path, _: Any) -> str | None:
        image = cv2.imread(str(here / "out/000001_erp.png"))
        return None if image is not None and image.shape == (32, 64, 3) else "no picture"

    return draft.done("splats", check, limit_s=60.0)


def _runs(draft: Draft) -> Spoiled:
    """Case of a whole run on readable but wrong input: other clocks, worlds and settings."""
    draft.copy("slam.tum", "times.csv")
    options: list[str] = []
    how = int(draft.rng.integers(4))
    if how == 0:
        spoil_file(draft, "slam.tum", draft.pick([_columns, _lines]))
    elif how == 1:
        options = ["--fps", draft.pick(["0.01", "0.1", "0.5", "1", "4", "20", "200", "0.002"])]
    elif how == 2:
        draft.edit("times.csv", _columns(draft), "columns")
        options = ["--timestamps", "times.csv"]
    else:
        options = ["--set", _extreme(draft)]
    poses = ["slam.tum"] if draft.rng.random() < 0.85 else ["--no-trajectory"]
    draft.arguments = ["--quiet", "refine", _FRAMES, *poses, *options, "--out", "out"]
    for key, value in _flat(SETTINGS):
        draft.arguments += ["--set", f"{key}={json.dumps(value)}"]
    draft.changes.append(" ".join([*poses, *options])[:150])
    with_features = poses == ["slam.tum"]

    def features(source: Path, here: Path) -> None:
        origin = {"frames": str(source / "frames")}
        if with_features:
            origin |= {"trajectory": str((here / "slam.tum").resolve())}
        copied(source / "run/stages/features", here / "out/stages/features")
        marker = {"gsba": "", "origin": origin, "wrote": []}
        (here / "out/gsba.json").write_text(json.dumps(marker))

    draft.steps.append(features)

    def check(here: Path, result: Any) -> str | None:
        summary = json.loads((here / "out/report.json").read_text())["summary"]
        residual = summary["median_residual_deg"]
        if residual is not None and not residual < 1:
            return f"median residual {residual}"
        found = read_trajectory(here / "out/trajectory.tum").world_T_rigs
        if len(found) < 3:
            return f"{len(found)} poses"
        names = [row["frame"] for row in csv.DictReader(_lines_of(here / "out/poses.csv"))]
        if len(found) == len(names) == NUM and how != 3:
            order = [int(name) for name in names]
            fit = pose_similarity(found, _TRUTH.world_T_rigs[order])
            off = fit.points(found[:, :3, 3]) - _TRUTH.world_T_rigs[order, :3, 3]
            extent = np.ptp(_TRUTH.world_T_rigs[:, :3, 3], axis=0).max()
            if np.abs(off).max() > 0.2 * extent:
                return f"{np.abs(off).max() / extent:.2f} of the walk off"
        return None

    return draft.done("runs", check, limit_s=240.0, resumes=True)


DRAWN: Mapping[str, Callable[[Draft], Spoiled]] = {
    "settings": _settings,
    "trajectories": _trajectories,
    "starts": _starts,
    "images": _images,
    "placements": _placements,
    "edited runs": _edited,
    "depth maps": _depths,
    "videos": _videos,
    "splats": _splats,
    "runs": _runs,
}
_RUN, _FRAMES = "@run", "@frames"  # of the prepared folder: see `located`
_WALK = walk_poses("open", "locked", 3 * NUM, 0)
_TRUTH = Trajectory(_WALK.timestamps[:NUM], _WALK.world_T_rigs[:NUM])


def located(arguments: Sequence[str], prepared: Path) -> list[str]:
    """Arguments with paths of prepared files that are used without a copy."""
    known = {_RUN: str(prepared / "run"), _FRAMES: str(prepared / "frames")}
    return [known.get(argument, argument) for argument in arguments]


def small_settings() -> list[str]:
    """Settings that make runs on tiny frames fast."""
    sizes = [f"cubemap.{name}_face_size=64" for name in ("min", "max")]
    return [part for size in [*sizes, "features.max_per_face=16"] for part in ("--set", size)]


def _flat(tree: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of a tree of settings."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{place}{key}.")
        else:
            yield f"{place}{key}", value


def _extreme(draft: Draft) -> str:
    """Setting at or beyond the ends of its range; most of these must still work."""
    skipped = ("video.", "export.", "placement.", "splat.", "photometric.", "solver.num", "factors")
    numbers = [
        (key, value)
        for key, value in _flat(RefineSettings().model_dump())
        if isinstance(value, int | float) and not isinstance(value, bool)
        if not key.startswith(skipped)
    ]
    key, value = draft.pick(numbers)
    factor = draft.pick([0, 0.01, 0.1, 0.5, 2, 10, 100])
    return f"{key}={round(value * factor) if isinstance(value, int) else value * factor}"


def spoil_file(
    draft: Draft, name: str, how: Callable[[Draft], Callable[[bytes], bytes]] | None = None
) -> None:
    """Damage a table or a binary file in a random or the given way."""
    ways = [change_bytes, _word, _word, _lines, _columns, _encoded]
    if name.endswith((".msg", ".png")):
        ways = [change_bytes]
    chosen = how or draft.pick(ways)
    draft.edit(name, chosen(draft), chosen.__name__.strip("_"))


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


def _word(draft: Draft) -> Callable[[bytes], bytes]:
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


def _lines(draft: Draft) -> Callable[[bytes], bytes]:
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


def _columns(draft: Draft) -> Callable[[bytes], bytes]:
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


def _encoded(draft: Draft) -> Callable[[bytes], bytes]:
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


def _array(draft: Draft) -> Callable[[bytes], bytes]:
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


def _spoil_names(draft: Draft, folder: str) -> None:
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


def check_export(here: Path, _: Any) -> str | None:
    """Fault of an export; None = none."""
    if not (here / "out/transform.json").exists():
        return "no transform.json"
    transform = json.loads((here / "out/transform.json").read_text())
    rotation = np.array(transform["rotation"])
    wrong = _not_finite(
        [transform["scale"], transform["matrix"], transform["inverse"], transform["offset"]]
    )
    if wrong or not transform["scale"] > 0 or not np.allclose(rotation @ rotation.T, np.eye(3)):
        return wrong or "transform"
    if np.linalg.det(rotation) < 0:
        return "a mirrored world"
    path = here / "out/trajectory.tum"
    return _not_finite(read_trajectory(path).world_T_rigs.tolist()) if path.exists() else None


def _not_finite(tree: Any) -> str | None:
    values = [tree] if not isinstance(tree, dict | list) else None
    if values is None:
        parts = tree.values() if isinstance(tree, dict) else tree
        return next((wrong for part in parts if (wrong := _not_finite(part))), None)
    return None if isinstance(tree, int | float) and np.isfinite(tree) else f"{tree!r:.40}"


def _lines_of(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").splitlines()


def copied(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target, dirs_exist_ok=True)
    else:
        shutil.copy(source, target)


def _written(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def prepare(out: Path) -> None:
    """Make the inputs of all cases once: a walk and its run, tables, images, a video."""
    from gsba import GsbaError, load_run, refine
    from gsba.splat import read_ply
    from gsba.splat.gaussians import from_cloud
    from gsba.splat.ply import write_ply

    try:
        load_run(out / "light")  # of this version
        return
    except GsbaError:
        pass
    shutil.rmtree(out, ignore_errors=True)
    slam = degrade(_TRUTH, 0)
    _make_pictures(out)
    _make_tables(out, slam)
    settings = RefineSettings.model_validate(SETTINGS)
    result = refine(out / "frames", out / "slam.tum", out / "run", settings)
    for name in ("gsba.json", "stages/reconstruction.npz", "stages/frames.npz", "trajectory.tum"):
        copied(out / "run" / name, out / "light" / name)
    cloud = result.reconstruction
    write_ply(out / "splat.ply", from_cloud(cloud.points_world[:40], cloud.point_colors[:40], 1))
    load_run(out / "light")
    read_ply(out / "splat.ply")


def _make_pictures(out: Path) -> None:
    """Make the walk, its video, frames without texture or of noise, a mask, true depths."""
    import av
    from PIL import Image

    rng, scene = np.random.default_rng(0), build_gallery()
    for folder in ("frames", "flat", "noisy", "depth"):
        (out / folder).mkdir(parents=True)
    rows = [f"{f:06d}.jpg,{t!r}" for f, t in enumerate(_TRUTH.timestamps.tolist())]
    for table in (out / "times.csv", out / "frames/timestamps.csv"):
        table.write_text("\n".join(["name,timestamp", *rows]) + "\n")
    with av.open(str(out / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=4)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for f, world_T_rig in enumerate(_TRUTH.world_T_rigs):
            image = np.clip(render_erp(scene, world_T_rig, WIDTH, WIDTH // 2), 0, 255)
            image = image.astype(np.uint8)
            cv2.imwrite(str(out / f"frames/{f:06d}.jpg"), image[..., ::-1])
            cv2.imwrite(str(out / f"flat/{f:06d}.jpg"), np.full((32, 64, 3), 90, np.uint8))
            np.savez(out / f"depth/{f:06d}.npz", range=rng.uniform(1, 9, (16, 32)))
            for part in np.split(cv2.resize(image, (128, 64))[None].repeat(2, 0), 2):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(part[0], format="rgb24")))
        container.mux(stream.encode())
    cv2.imwrite(str(out / "mask.png"), np.full((32, 64), 255, np.uint8))
    for f, suffix in enumerate(("jpg", "png", "jpg", "jpg")):
        image = Image.fromarray(rng.integers(0, 256, (32, 64, 3), np.uint8))
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(
            {1: "N", 2: (48.0, f / 10, 0.0), 3: "E", 4: (11.0, 0.0, 0.0), 6: 500.0}
        )
        image.save(out / f"noisy/{f}.{suffix}", exif=exif)


def _make_tables(out: Path, slam: Trajectory) -> None:
    """Make poses in every format, and GPS positions."""
    import msgpack

    from gsba.geometry import inverse, quaternion_from_rotation

    write_tum(out / "slam.tum", slam)
    write_tum(out / "truth.tum", _TRUTH)
    write_tum(out / "keyframes.tum", Trajectory(slam.timestamps[::2], slam.world_T_rigs[::2]))
    rows = slam.world_T_rigs[:, :3].reshape(NUM, 12)
    np.savetxt(out / "poses.kitti", rows)
    rigs = inverse(slam.world_T_rigs)
    wxyz = quaternion_from_rotation(rigs[:, :3, :3])
    keyframes = {
        str(f): {
            "ts": float(slam.timestamps[f]),
            "rot_cw": wxyz[f, [1, 2, 3, 0]].tolist(),
            "trans_cw": rigs[f, :3, 3].tolist(),
        }
        for f in range(NUM)
    }
    (out / "map.msg").write_bytes(msgpack.packb({"cameras": {}, "keyframes": keyframes}))  # type: ignore[arg-type]
    x, y, z = _TRUTH.world_T_rigs[:, :3, 3].T
    places = np.column_stack([48 + z / 111_320, 11 + x / 74_490, 500 - y])
    lines = [
        f"{t!r},{a:.9f},{b:.9f},{c:.3f}"
        for t, (a, b, c) in zip(_TRUTH.timestamps.tolist(), places, strict=True)
    ]
    (out / "gps.csv").write_text("\n".join(["timestamp,lat,lon,alt", *lines]) + "\n")
    points = "\n".join(
        f'<trkpt lat="{a:.9f}" lon="{b:.9f}"><ele>{c:.3f}</ele>'
        f"<time>1970-01-01T00:00:{t:09.6f}Z</time></trkpt>"
        for t, (a, b, c) in zip(_TRUTH.timestamps, places, strict=True)
    )
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    (out / "track.gpx").write_text(f"{head}<gpx {space}><trk><trkseg>{points}</trkseg></trk></gpx>")
