"""Cases of `fuzz.py`: each number gives a damaged input, its command and a check of its output.
Undamaged inputs are made once: a walk and its run, tables, images, a video."""

import csv
import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from damage import (
    WORDS,
    Draft,
    Spoiled,
    change_array,
    change_bytes,
    change_columns,
    change_lines,
    change_member,
    change_tree,
    copied,
    spoil_file,
    spoil_names,
    written,
)

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
    "cubemap": {"min_face_size": 256, "max_face_size": 256},
    "features": {"max_per_face": 400},
    "patches": {"rounds": 0},
    "export": {"formats": []},
    "solver": {"num_threads": 2},
}
WALK = walk_poses("open", "locked", 3 * NUM, 0)
TRUTH = Trajectory(WALK.timestamps[:NUM], WALK.world_T_rigs[:NUM])


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


def prepare(out: Path) -> None:
    """Make the inputs of all cases once: a walk and its run, tables, images, a video."""
    from gsba import GsbaError, load_run, refine
    from gsba.splat import read_ply
    from gsba.splat.gaussians import from_cloud, write_ply

    try:
        load_run(out / "light")  # of this version
        return
    except GsbaError:
        pass
    shutil.rmtree(out, ignore_errors=True)
    slam = degrade(TRUTH, 0)
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
    rows = [f"{f:06d}.jpg,{t!r}" for f, t in enumerate(TRUTH.timestamps.tolist())]
    for table in (out / "times.csv", out / "frames/timestamps.csv"):
        table.write_text("\n".join(["name,timestamp", *rows]) + "\n")
    with av.open(str(out / "walk.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=4)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for f, world_T_rig in enumerate(TRUTH.world_T_rigs):
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
    write_tum(out / "truth.tum", TRUTH)
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
    x, y, z = TRUTH.world_T_rigs[:, :3, 3].T
    places = np.column_stack([48 + z / 111_320, 11 + x / 74_490, 500 - y])
    lines = [
        f"{t!r},{a:.9f},{b:.9f},{c:.3f}"
        for t, (a, b, c) in zip(TRUTH.timestamps.tolist(), places, strict=True)
    ]
    (out / "gps.csv").write_text("\n".join(["timestamp,lat,lon,alt", *lines]) + "\n")
    points = "\n".join(
        f'<trkpt lat="{a:.9f}" lon="{b:.9f}"><ele>{c:.3f}</ele>'
        f"<time>1970-01-01T00:00:{t:09.6f}Z</time></trkpt>"
        for t, (a, b, c) in zip(TRUTH.timestamps, places, strict=True)
    )
    space = 'xmlns="http://www.topografix.com/GPX/1/1"'
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    (out / "track.gpx").write_text(f"{head}<gpx {space}><trk><trkseg>{points}</trkseg></trk></gpx>")


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
        draft.steps.append(lambda _, here: written(here / "s.toml", change(whole)))
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
        spoil_names(draft, "flat")
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
    draft.arguments = ["--quiet", "export", RUN, "--to", to, "--out", "out", *up, *options, *size]
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
        draft.edit(f"light/{name}", change_member(draft, None, change_array(draft)), "array")
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
        draft.edit(name, change_member(draft, None, change_array(draft)), "array")
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
    draft.arguments = ["--quiet", "render", "splat.ply", RUN, "--frame", frame, "--out", "out"]
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
        spoil_file(draft, "slam.tum", draft.pick([change_columns, change_lines]))
    elif how == 1:
        options = ["--fps", draft.pick(["0.01", "0.1", "0.5", "1", "4", "20", "200", "0.002"])]
    elif how == 2:
        draft.edit("times.csv", change_columns(draft), "columns")
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
            fit = pose_similarity(found, TRUTH.world_T_rigs[order])
            off = fit.points(found[:, :3, 3]) - TRUTH.world_T_rigs[order, :3, 3]
            extent = np.ptp(TRUTH.world_T_rigs[:, :3, 3], axis=0).max()
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
RUN, _FRAMES = "@run", "@frames"  # of the prepared folder: see `located`


def located(arguments: Sequence[str], prepared: Path) -> list[str]:
    """Arguments with paths of prepared files that are used without a copy."""
    known = {RUN: str(prepared / "run"), _FRAMES: str(prepared / "frames")}
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
    skipped = ("video.", "export.", "placement.", "splat.", "solver.num", "factors")
    numbers = [
        (key, value)
        for key, value in _flat(RefineSettings().model_dump())
        if isinstance(value, int | float) and not isinstance(value, bool)
        if not key.startswith(skipped)
    ]
    key, value = draft.pick(numbers)
    factor = draft.pick([0, 0.01, 0.1, 0.5, 2, 10, 100])
    return f"{key}={round(value * factor) if isinstance(value, int) else value * factor}"


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
