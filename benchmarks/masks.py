"""What masks find and what they are worth: people and a carrier pasted into a known walk.

    python benchmarks/masks.py --data DATA --out WORK --json FILE --markdown FILE

`DATA/SCENE` holds `images/`, `slam.tum` and `groundtruth.tum`; without `--data` the gallery of
`gsba demo` is rendered. `--splat STEPS` trains a splat on each run and measures it against clean
frames that were held out. Runs are kept in WORK and resumed while code and settings stay the same.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import machine

from gsba import RefineSettings, refine
from gsba.carrier import carrier_mask, find_carrier
from gsba.config import ExportSettings, SplatSettings
from gsba.demo import make_walk
from gsba.demo.people import make_people, paste_people
from gsba.evaluate import evaluate
from gsba.evaluate_splat import train_and_measure
from gsba.export.images import write_image
from gsba.geometry import bearings_from_erp
from gsba.read import load_erp, load_mask, read_trajectory, scan
from gsba.read.frames import find_panoramas
from gsba.read.images import decode
from gsba.splat.backend import choose_backend
from gsba.splatting import load_faces, make_views, refined_frames, split_frames
from gsba.store import digest, fingerprint
from gsba.types import FrameSet, Reconstruction

NUM_PEOPLE = 4
MAX_ATE, MAX_CLEAN, MIN_CARRIER, MAX_DB = 1.10, 0.01, 0.9, 0.2
FACE_SIZE = 128  # pixels, of splats


@dataclass(frozen=True, slots=True)
class Row:
    """One run or one carrier."""

    name: str
    ate: float | None = None  # map units of the reference
    rotation_deg: float | None = None  # relative, median
    masked: float | None = None  # part of all pixels
    iou: float | None = None
    recall: float | None = None
    false: float | None = None  # part of all pixels
    psnr: float | None = None  # dB, of a splat against clean frames held out


def people_rows(scene: Path, work: Path, tall: float, steps: int) -> list[Row]:
    """Runs of a scene clean and with people, without and with masks."""
    truth = read_trajectory(scene / "groundtruth.tum")
    clean = scan(scene / "images")
    crowded = work / f"{scene.name}-with-people"
    up = -truth.world_T_rigs[:, :3, 1].mean(axis=0)
    people = make_people(truth.world_T_rigs, NUM_PEOPLE, tall, up / np.linalg.norm(up))
    for f, name in enumerate(clean.names):
        path = crowded / "images" / clean.paths[f][0].name
        if not (path.exists() and (crowded / "true" / f"{name}.png").exists()):
            image, outline = paste_people(load_erp(clean, f), truth.world_T_rigs[f], people, f)
            write_image(path, image)
            write_image(crowded / "true" / f"{name}.png", outline.astype(np.uint8) * 255)
    times = (scene / "images" / "timestamps.csv").read_bytes()
    (crowded / "images" / "timestamps.csv").write_bytes(times)
    settings = RefineSettings(export=ExportSettings(formats=()))
    rows = []
    for name, images, masks in (
        ("clean", scene, None),
        ("clean, distractors looked for", scene, "distractors"),
        ("people", crowded, None),
        ("people, distractors masked", crowded, "distractors"),
    ):
        out = work / f"{scene.name}-{name.replace(', ', '-').replace(' ', '-')}"
        result = refine(images / "images", scene / "slam.tum", out, settings, masks=masks)
        errors = evaluate(read_trajectory(out / "trajectory.tum"), truth)
        numbers = _masks(result.frames, crowded if images is crowded else None) if masks else {}
        rotation = errors.rpe_rotation_deg.median
        if steps:
            numbers["psnr"] = splat_psnr(
                result.reconstruction,
                result.frames,
                clean,
                steps,
                out.with_name(f"{out.name}-splat"),
            )
        rows.append(Row(name, errors.ate.rmse, rotation, **numbers))
    return rows


def splat_psnr(
    reconstruction: Reconstruction, frames: FrameSet, clean: FrameSet, steps: int, out: Path
) -> float:
    """PSNR of a splat trained on a run's frames with their masks, against clean frames held out."""
    settings = SplatSettings(
        iterations=steps, face_size=FACE_SIZE, sh_degree=1, max_gaussians=40_000, backend="cpu"
    )
    split = split_frames(refined_frames(reconstruction), settings.held_out_every)
    poses, backend = reconstruction.world_T_rigs, choose_backend("cpu", 2)
    seen, unseen = (
        make_views(*load_faces(source, part, FACE_SIZE), poses[part])
        for source, part in ((frames, split.training), (clean, split.held_out))
    )
    files = fingerprint([*(p[0] for p in frames.paths), *frames.mask_paths])
    key = digest(files, poses.tolist(), settings)
    _, found = train_and_measure(
        reconstruction, frames, poses, split, seen, unseen, settings, backend, out, key, None
    )
    return found.mean.psnr


def _masks(frames: FrameSet, crowded: Path | None) -> dict[str, float]:
    """How the masks of a run compare with where people are."""
    inter = union = true_sum = false = masked = 0.0
    for f, name in enumerate(frames.names):
        mask = load_mask(frames, f)
        found = np.zeros((frames.height, frames.width), bool) if mask is None else ~mask
        masked += found.mean()
        if crowded is not None:
            size = frames.width, frames.height
            true = decode(crowded / "true" / f"{name}.png", size, gray=True) > 127
            inter, union = inter + np.sum(found & true), union + np.sum(found | true)
            true_sum, false = true_sum + np.sum(true), false + np.mean(found & ~true)
    numbers = {"masked": masked / len(frames)}
    if crowded is not None:
        numbers |= {"iou": inter / union, "recall": inter / true_sum, "false": false / len(frames)}
    return {key: float(value) for key, value in numbers.items()}


def carrier_rows(frames: FrameSet, work: Path) -> list[Row]:
    """A bag and a stick pasted into a walk, fixed in the picture and turning below it."""
    rng = np.random.default_rng(0)
    height, width = frames.height, frames.width
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
    rays = bearings_from_erp(grid, width, height)
    longitude = np.arctan2(rays[..., 0], rays[..., 2])
    low = np.arcsin(rays[..., 1])
    bag = low > np.deg2rad(65 + 5 * np.sin(3 * longitude + 1))
    stick = (np.abs(longitude - 0.7 - low / 3) < 0.06) & (low > np.deg2rad(35))
    outline, rows = bag | stick, []
    look = np.array([38, 34, 30]) * (1 + 0.3 * np.sin(5 * longitude + 20 * low))[..., None]
    turns = np.round(np.cumsum(rng.normal(0, 0.06, len(frames))) * width).astype(int)
    for name, moves in (("carrier, lock off", 0 * turns), ("carrier, lock on", turns)):
        folder = work / name.replace(", ", "-").replace(" ", "-")
        for f, turn in enumerate(moves):
            image = load_erp(frames, f).copy()
            at = np.roll(outline, turn, axis=1)
            image[at] = np.roll(look, turn, axis=1)[at].astype(np.uint8)
            write_image(folder / f"{frames.names[f]}.jpg", image)
        pasted = find_panoramas(folder)
        carrier = find_carrier(pasted)
        inter = union = false = true = 0.0
        for f, turn in enumerate(moves):
            found, at = ~carrier_mask(carrier, pasted, f), np.roll(outline, turn, axis=1)
            inter, union = inter + np.sum(found & at), union + np.sum(found | at)
            true, false = true + np.sum(at), false + np.mean(found & ~at)
        parts = inter / union, inter / true, false / len(frames)
        rows.append(Row(name, None, None, carrier.share, *map(float, parts)))
    return rows


def table(rows: Sequence[Row]) -> str:
    """The rows in Markdown."""
    lines = [
        "| run | ATE rmse, 1e-3 | rel. rot., deg | masked | IoU | recall | false | splat, dB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        cells = [
            _cell(row.ate, 1e3, ".2f"),
            _cell(row.rotation_deg, 1, ".4f"),
            _cell(row.masked, 1, ".2%"),
            _cell(row.iou, 1, ".3f"),
            _cell(row.recall, 1, ".3f"),
            _cell(row.false, 1, ".2%"),
            _cell(row.psnr, 1, ".2f"),
        ]
        lines.append(f"| {row.name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(value: float | None, scale: float, form: str) -> str:
    return "" if value is None else f"{scale * value:{form}}"


def missed(rows: Sequence[Row]) -> list[str]:
    """Targets that do not hold."""
    named = {row.name: row for row in rows}
    out = []
    crowd, clean = named.get("people, distractors masked"), named.get("clean")
    if crowd and clean and crowd.ate and clean.ate and crowd.ate > MAX_ATE * clean.ate:
        out.append(f"with masks the ATE is {crowd.ate / clean.ate:.2f} of the clean run's")
    if crowd and clean and crowd.psnr and clean.psnr and crowd.psnr < clean.psnr - MAX_DB:
        out.append(f"a splat with masks is {clean.psnr - crowd.psnr:.2f} dB behind the clean one")
    looked = named.get("clean, distractors looked for")
    if looked and (looked.masked or 0) > MAX_CLEAN:
        out.append(f"{looked.masked:.2%} of clean frames are masked")
    for row in rows:
        if row.name.startswith("carrier") and (row.iou or 0) < MIN_CARRIER:
            out.append(f"{row.name}: IoU {row.iou:.3f}")
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of scenes; none: render the gallery")
    parser.add_argument("--scene", default="aisle_loop")
    parser.add_argument("--tall", type=float, default=0.4, help="height of a person, map units")
    parser.add_argument("--splat", type=int, default=0, metavar="STEPS", help="of each training")
    parser.add_argument("--out", type=Path, default=Path("masks-benchmark"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    work, scene, tall = arguments.out, None, arguments.tall
    if arguments.data is not None:
        scene = arguments.data / arguments.scene
    else:
        scene, tall = work / "gallery", 1.7
        if not (scene / "groundtruth.tum").exists():
            make_walk(scene, "rectangle", "locked")
    rows = people_rows(scene, work, tall, arguments.splat)
    rows += carrier_rows(find_panoramas(scene / "images"), work)
    misses = missed(rows)
    verdict = "; ".join(misses) or "all targets hold"
    text = f"{scene.name}, {machine()}\n\n{table(rows)}\n\n{verdict}\n"
    print(text)
    if arguments.markdown:
        arguments.markdown.write_text(text)
    if arguments.json:
        values = [{name: getattr(row, name) for name in Row.__slots__} for row in rows]
        arguments.json.write_text(json.dumps({"scene": scene.name, "rows": values}, indent=1))
    return 1 if misses else 0


if __name__ == "__main__":
    sys.exit(main())
