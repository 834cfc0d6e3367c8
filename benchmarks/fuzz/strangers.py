"""Cases of malicious files for `fuzz.py`, besides those of `inputs.py`."""

import importlib.util
import json
import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import inputs as usual
import numpy as np
import yaml
from damage import (
    TREES,
    WORDS,
    Draft,
    Spoiled,
    change_bytes,
    change_member,
    change_tree,
    copied,
    spoil_file,
)
from inputs import NUM, small_settings

from gsba.camera.calibration import calibration_json
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import Fisheye

FAMILIES = {  # beside the usual hundred cases
    **usual.FAMILIES,
    "names": 8,
    "links": 10,
    "calibrations": 14,
    "tiffs": 8,
    "clusters": 6,
    "numbers": 8,
    "insta360": 8,
}
_SCANS = ("cloud.pcd", "binary.pcd", "cloud.ply", "mesh.obj", "cloud.las", "cloud.laz")
if importlib.util.find_spec("open3d") and importlib.util.find_spec("laspy"):
    FAMILIES["scans"] = 2  # seconds each
_NAMES = (
    "../x",
    "../../out/x",
    "/tmp/gsba-fuzz-x",
    "a/b",
    "..",
    ".",
    "",
    "a\nb",
    "a\0b",
    "~",
    "a b",
)


def spoil(number: int, seed: int, family: str | None = None) -> Spoiled:
    """Case `number` of a seed, of one family or of all in their proportions."""
    rng = np.random.default_rng([seed, number])
    shares = np.array(list(FAMILIES.values())) / sum(FAMILIES.values())
    chosen = str(rng.choice(list(FAMILIES), p=shares))
    return {**usual.DRAWN, **_DRAWN}[family or chosen](Draft(rng))


def prepare(out: Path) -> None:
    """Make the inputs of all cases once."""
    usual.prepare(out)
    if (out / "strangers").exists():
        return
    front = Fisheye(
        32, 32, 9.0, (16.0, 16.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.01)
    )
    back = Fisheye(
        32, 32, 9.0, (16.0, 16.0), (0.0, 0.0, 0.0, 0.0), (0.0, np.pi, 0.0), (0.0, 0.0, -0.01)
    )
    tree = calibration_json((front, back), np.array([0, 0, 0.01]), "m", {})
    made = out / "strangers"
    made.mkdir()
    (made / "lenses.json").write_text(json.dumps(tree))
    camera = {"camera_model": "pinhole", "distortion_model": "equidistant", "resolution": [32, 32]}
    camera |= {"intrinsics": [9.0, 9.0, 15.5, 15.5], "distortion_coeffs": [0.0, 0.0, 0.0, 0.0]}
    turned = np.diag([-1.0, 1, -1, 1]).tolist()
    chain = {"cam0": camera, "cam1": camera | {"T_cn_cnm1": turned}}
    (made / "chain.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(chain))))
    (made / "scheduler.json").write_text(json.dumps({"type": "Scheduler", "address": "tls://"}))
    trailer = _insta360_trailer()
    (made / "walk.insv").write_bytes((out / "walk.mp4").read_bytes() + trailer)
    (made / "precious.txt").write_text("precious")
    cv2.imwrite(str(made / "a.tif"), np.full((32, 64, 3), 90, np.uint8))
    for lens in ("front", "back"):
        (made / "raw" / lens).mkdir(parents=True)
        for number in range(NUM):
            disc = cv2.circle(np.zeros((32, 32, 3), np.uint8), (16, 16), 15, (90, 90, 90), -1)
            cv2.imwrite(str(made / f"raw/{lens}/{number}.png"), disc)
    _make_scans(made, load_run(out / "run")[0].points_world)


def _make_scans(made: Path, points: np.ndarray) -> None:
    """Make scans of a run's points in all formats."""
    num, points = len(points), points.astype(np.float32)
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {num}\nHEIGHT 1\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {num}\nDATA "
    lines = "".join(f"{x} {y} {z}\n" for x, y, z in points)
    (made / "cloud.pcd").write_text(f"{head}ascii\n{lines}")
    (made / "binary.pcd").write_bytes(f"{head}binary\n".encode() + points.tobytes())
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    start = f"ply\nformat ascii 1.0\nelement vertex {num}\n{properties}end_header\n"
    (made / "cloud.ply").write_text(start + lines)
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in points[:300])
    faces = "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, 299))
    (made / "mesh.obj").write_text(corners + faces)
    if "scans" in FAMILIES:
        import laspy  # pyright: ignore[reportMissingImports]

        header = laspy.LasHeader(point_format=2, version="1.4")
        header.scales = np.full(3, 1e-4)
        laser = laspy.LasData(header)
        laser.x, laser.y, laser.z = points.T
        for suffix in ("las", "laz"):
            laser.write(str(made / f"cloud.{suffix}"))


def _copy(draft: Draft, name: str) -> None:
    """Copy a prepared malicious file."""
    draft.steps.append(lambda source, here: copied(source / "strangers" / name, here / name))


def _unharmed(here: Path, _: Any = None) -> str | None:
    """Fault if a command changed files outside of its run; None = none."""
    whole = (here / "elsewhere/precious.npz").read_text() == "precious"
    alone = sorted(path.name for path in (here / "elsewhere").iterdir()) == ["precious.npz"]
    return None if whole and alone else "a file elsewhere was written or deleted"


def _refined(here: Path, _: Any) -> str | None:
    """Fault of poses of images with hardly any texture; None = none."""
    found = read_trajectory(here / "out/trajectory.tum").world_T_rigs
    return None if np.isfinite(found).all() else "poses"


def _names(draft: Draft) -> Spoiled:
    """Case of a run whose frames have names with other folders."""
    draft.copy("light")
    name, at = draft.pick([*_NAMES, *WORDS]), draft.rng.random()
    key = draft.pick(["names", "names", "names", "faces", "layout", "paths", "mask_paths"])

    def change(data: bytes) -> bytes:
        tree = json.loads(data)
        if key == "faces":
            tree["value"][key] = [name]
        elif key == "layout":
            tree["value"][key] = name
        else:
            rows = tree["value"][key]
            rows[int(at * len(rows))] = [name] if key == "paths" else name
        return json.dumps(tree).encode()

    draft.edit("light/stages/frames.npz", change_member(draft, "manifest.json", change), "names")
    draft.changes.append(f"{key}: {name[:40]!r}")
    draft.arguments = ["--quiet", "export", "light", "--out", "out", "--face-size", "16"]
    draft.arguments += ["--to", draft.pick(["colmap", "nerfstudio", "colmap-erp", "tum"])]

    def check(here: Path, _: Any) -> str | None:
        wrong = {path.name for path in here.iterdir()} - {"light", "out"}
        return f"wrote {wrong}" if wrong or Path("/tmp/gsba-fuzz-x").exists() else None

    return draft.done("names", check)


def _links(draft: Draft) -> Spoiled:
    """Case of links, pipes and folders in place of a run's files."""
    draft.copy("light", "truth.tum", "flat", "slam.tum")
    places = ["stages", "stages/frames.npz", "stages/shards", "stages/features", "stages/x.npz"]
    place = draft.pick([*places, "masks", "gsba.json", "trajectory.tum", "config.toml", "colmap"])
    kind = draft.pick(["link", "link", "file link", "pipe", "folder", "loop"])
    command = draft.pick(["export", "evaluate", "refine", "fresh"])
    options = {
        "export": ["export", "light", "--to", "colmap", "--face-size", "16"],
        "evaluate": ["evaluate", "light", "--truth", "truth.tum"],
        "refine": ["refine", "flat", "slam.tum", "--fps", "2", "--out", "light"],
        "fresh": ["refine", "flat", "slam.tum", "--fps", "2", "--out", "light", "--fresh"],
    }

    def step(source: Path, here: Path) -> None:
        (here / "elsewhere").mkdir()
        (here / "elsewhere/precious.npz").write_text("precious")
        path = here / "light" / place
        if path.exists():
            path.rename(here / f"before-{path.name}")
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        else:
            to = {"link": "elsewhere", "file link": "elsewhere/precious.npz", "loop": "light"}[kind]
            path.symlink_to(here / to)

    draft.steps.append(step)
    draft.arguments = ["--quiet", *options[command]]
    draft.arguments += small_settings() if "refine" in options[command] else []
    draft.changes.append(f"{command} with a {kind} at {place}")
    spoiled = draft.done("links", _unharmed, resumes=True)
    return _Ours(**{name: getattr(spoiled, name) for name in spoiled.__dataclass_fields__})


class _Ours(Spoiled):
    """Case whose command may write to its run folder only."""

    def keeps(self, path: Path) -> bool:
        return "light" not in path.parts


def _calibrations(draft: Draft) -> Spoiled:
    """Case of damaged calibrations of raw fisheyes."""
    name = draft.pick(["lenses.json", "chain.yaml"])
    draft.copy("strangers/raw", "slam.tum")
    _copy(draft, name)
    how = int(draft.rng.integers(5))
    if how == 0 and name == "lenses.json":
        draft.edit(name, change_tree(draft), "tree")
    elif how == 1 and name == "lenses.json":
        unit = draft.pick(["mm", "cm", "furlong", "map", "M", *TREES])
        draft.edit(
            name,
            lambda data: json.dumps(json.loads(data) | {"unit": unit}).encode(),
            f"unit {unit!r:.30}",
        )
    elif how == 2 and name == "chain.yaml":
        # Aliases of aliases stand for gigabytes in PyYAML, thousands of open brackets overflow its
        # stack: the loader refuses the first alias, and files too large for a calibration.
        odd = [b"a0: &a0 [x]\nb0: *a0\n", b"!!python/object/apply:print []\n", b"--- 1\n"]
        start = draft.pick([*odd, b"? [\n" * 20, b"- " * 20])
        draft.edit(name, lambda data: start + data, f"begins with {start[:20]!r}")
    else:
        spoil_file(draft, name)
    draft.arguments = ["--quiet", "refine", "strangers/raw", "slam.tum", "--fps", "2"]
    draft.arguments += ["--out", "out", "--calibration", name, *small_settings()]
    return draft.done("calibrations", _refined, resumes=True)


def _tiffs(draft: Draft) -> Spoiled:
    """Case of TIFF images that are damaged, or whose directory claims much memory."""
    draft.copy("flat", "slam.tum")
    _copy(draft, "a.tif")
    if draft.rng.random() < 0.5:
        draft.edit("a.tif", change_bytes(draft), "bytes")
    else:
        tags = [256, 257, 258, 259, 262, 273, 274, 277, 278, 279, 284, 322, 324, 325, 339, 34665]
        # Readers of TIFF take memory and minutes for what directories of thousands of tags with
        # millions of values claim: 4096 tags of 64 values are the most that gsba reads.
        counts = [0, 1, 3, 64, 65, 65_535]
        entries = [
            (
                draft.pick(tags),
                draft.pick([1, 3, 4, 16, 0, 12]),
                draft.pick(counts),
                draft.pick(counts),
            )
            for _ in range(draft.pick([1, 20, 4097]))
        ]
        fixed = [(256, 3, 1, 64), (257, 3, 1, 32), (258, 3, 1, 8), (262, 3, 1, 1)]
        entries = draft.pick([entries, fixed + entries, fixed + entries[:1] * 4097])
        whole = b"II*\0" + struct.pack("<IH", 8, len(entries))
        whole += b"".join(struct.pack("<HHII", *entry) for entry in entries)
        draft.edit("a.tif", lambda _: whole + bytes(2_000_000), f"{len(entries)} tags")

    def step(_: Path, here: Path) -> None:
        for path in (here / "flat").iterdir():
            path.unlink()
        for number in range(4):
            (here / f"flat/{number}.tif").write_bytes((here / "a.tif").read_bytes())

    draft.steps.append(step)
    draft.arguments = ["--quiet", "refine", "flat", "slam.tum", "--fps", "2", "--out", "out"]
    gps = ["--set", "placement.gps=exif"] if draft.rng.random() < 0.3 else []
    draft.arguments += [*small_settings(), *gps]
    return draft.done("tiffs", _refined, resumes=True)


def _insta360_trailer() -> bytes:
    """Trailer of a camera's video: gyro, exposures, fixes, lenses, and their directory."""
    lenses = b"2_15.5_16_16_0_0_0_15.5_48_16_0_0_180_64_32_1"
    metadata = b"\x12\x02X1" + b"\x2a" + bytes([len(lenses)]) + lenses + b"\xf0\x03\x01"
    gyro = b"".join(struct.pack("<q6H", 10_000 * n, *[33_000 + n] * 6) for n in range(300))
    exposures = b"".join(struct.pack("<qd", 33_000 * n, 0.01) for n in range(90))
    fixes = 9 * struct.pack("<qHcdcdc3d", 1_700_000_000, 1, b"A", 5, b"N", 5, b"E", 1, 1, 1)
    body = entries = b""
    records = (7, 0, fixes), (4, 0, exposures), (3, 0, gyro), (1, 1, metadata)
    for number, form, content in records:
        entries += struct.pack("<BBII", number, form, len(content), len(body))
        body += content + struct.pack("<BBI", form, number, len(content))
    body += entries + struct.pack("<BBI", 0, 0, len(entries)) + bytes(32)
    signature = b"8db42d694ccc418790edff439fe026bf"
    return body + struct.pack("<II", len(body) + 40, 3) + signature


def _insta360(draft: Draft) -> Spoiled:
    """Case of a camera's video with a damaged trailer: its lenses and its gyro."""
    draft.copy("flat", "slam.tum")
    _copy(draft, "walk.insv")
    count, change = draft.pick([120, 300, 9000]), change_bytes(draft)  # bytes with more that leads
    draft.edit("walk.insv", lambda data: data[:-count] + change(data[-count:]), f"last {count}")
    if draft.rng.random() < 0.5:
        draft.arguments = ["--quiet", "extract", "walk.insv", "--out", "out"]
        return draft.done("insta360", lambda *_: None, resumes=True)
    draft.arguments = ["--quiet", "refine", "flat", "slam.tum", "--fps", "2", "--out", "out"]
    draft.arguments += ["--imu", "walk.insv", *small_settings()]
    return draft.done("insta360", _refined, resumes=True)


def _clusters(draft: Draft) -> Spoiled:
    """Case of invalid schedulers."""
    draft.copy("flat", "slam.tum")
    _copy(draft, "scheduler.json")
    odd = [
        f"{kind}:{word}" for kind in ("local", "slurm", "tcp") for word in WORDS if word != "1e18"
    ]
    odd = [address for address in odd if address not in ("local:1", "local:٣")]
    places = [
        "tls://",
        "tcp://",
        "tcp:///",
        "tcp://:",
        "tcp://::1",
        "ucx://x",
        "inproc://x",
        "x.json",
        ".",
    ]
    address = draft.pick([*odd, *places, *["scheduler.json"] * 20])
    if address == "scheduler.json":
        way = draft.pick(
            [change_tree(draft), change_bytes(draft), lambda _: draft.pick([b"{}", b""])]
        )
        draft.edit(address, way, "spoiled")
    draft.changes.append(f"--cluster {address[:40]}")
    draft.arguments = ["--quiet", "refine", "flat", "slam.tum", "--fps", "2", "--out", "out"]
    draft.arguments += ["--cluster", address, *small_settings()]
    return draft.done("clusters", lambda *_: "frames that show nothing were refined", resumes=True)


def _numbers(draft: Draft) -> Spoiled:
    """Case of implausible sizes of output."""
    large = [str(10**k) for k in (6, 9, 12, 20, 400)]
    number = draft.pick([*WORDS, *large, "-5", "1", "2"])
    commands = [
        ["demo", "--out", "out", "--frames", number],
        [
            "demo",
            "--out",
            "out",
            "--frames",
            "4",
            "--width",
            draft.pick([*large, "1", "-2", "33", "x"]),
        ],
        ["train", usual.RUN, "--iterations", draft.pick([*large[2:], "0", "-1", "x"])],
        ["train", usual.RUN, "--iterations", "1", "--face-size", draft.pick([*large, "0", "x"])],
        [
            "export",
            usual.RUN,
            "--to",
            "tum",
            "--out",
            "out",
            "--map",
            draft.pick([*large, number]),
        ],
    ]
    draft.arguments = ["--quiet", *draft.pick(commands)]
    draft.changes.append(" ".join(draft.arguments)[:120])
    return draft.done("numbers", lambda *_: None, resumes=True)


def _scans(draft: Draft) -> Spoiled:
    """Case of scans that hold fewer points than they claim.

    Parsers of clouds allocate what a damaged header claims, or crash beyond the end of the file: a
    file that is cut short stands for these, and is refused before it is parsed.
    """
    name = draft.pick(_SCANS)
    draft.copy("light", "truth.tum")
    _copy(draft, name)
    part = draft.pick([0.0, 0.5, 0.9, 0.999])
    draft.edit(name, lambda data: data[: int(part * len(data))], f"cut to {part:.1%}")
    draft.arguments = ["--quiet", "evaluate", "light", "--scan", name]
    return draft.done("scans", lambda *_: None, limit_s=60.0)


_DRAWN: Mapping[str, Callable[[Draft], Spoiled]] = {
    "names": _names,
    "links": _links,
    "calibrations": _calibrations,
    "tiffs": _tiffs,
    "clusters": _clusters,
    "numbers": _numbers,
    "insta360": _insta360,
    "scans": _scans,
}
