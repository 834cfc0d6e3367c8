"""Recall and effect of masks: people and a carrier pasted into a known walk.

    python benchmarks/masks.py --data DATA --out WORK --json FILE --markdown FILE

`DATA/SCENE` holds `images/`, `slam.tum` and `groundtruth.tum`; without `--data` the gallery of
`gsba demo` is rendered. If there is `DATA/apartment`, its carrier is compared with an outline drawn
by hand. Each of `--seeds` determines people, the start of a splat, and noise of one grey level, for
frames with and without people: a run's ATE scatters by a fifth over such noise, so that means are
compared. Frames without people are also decoded, changed and encoded. `--splat STEPS` trains a
splat on each run and measures it against held-out frames without people. Runs are kept in WORK and
resumed while code and settings stay the same.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from common import machine
from people import make_people, paste_people

from gsba import RefineSettings, refine
from gsba.camera.sphere import bearings_from_erp
from gsba.config import ExportSettings, SplatSettings
from gsba.demo import make_walk
from gsba.disk import write_image
from gsba.evaluate.splats import PosedViews, train_and_measure
from gsba.evaluate.trajectory import evaluate
from gsba.frames.files import decode
from gsba.frames.masks import load_mask
from gsba.frames.pixels import load_erp
from gsba.frames.scan import find_panoramas, scan
from gsba.masks.carrier import carrier_mask, find_carrier
from gsba.splat.backend import choose_backend
from gsba.splat.scene import load_faces, refined_frames, split_frames
from gsba.store.store import digest, fingerprint
from gsba.trajectory.files import read_trajectory
from gsba.types import FrameSet, Reconstruction

NUM_PEOPLE = 4
MAX_ATE, MAX_CLEAN, MIN_CARRIER, MAX_REST, MAX_DB = 1.10, 0.01, 0.9, 0.03, 0.2
OUTLINE = Path(__file__).parent / "reference" / "apartment_carrier.csv"
OUTLINE_WIDTH = 2688  # pixels of the panorama it is drawn on
LOW_ROWS = 0.86  # part of the height below which the carrier's recall is measured
NOISE_GREY = 1.0  # standard deviation, grey levels
FACE_SIZE = 128  # pixels, of splats


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one run or of one carrier."""

    name: str
    ate: float | None = None  # map units of the reference
    rotation_deg: float | None = None  # relative, median
    masked: float | None = None  # part of all pixels
    iou: float | None = None
    recall: float | None = None
    false: float | None = None  # part of all pixels
    psnr: float | None = None  # dB, of a splat against clean frames held out


def people_rows(scene: Path, work: Path, tall: float, steps: int, seed: int) -> list[Row]:
    """Rows of runs without people, with people, and with people and masks."""
    truth = read_trajectory(scene / "groundtruth.tum")
    work.mkdir(parents=True, exist_ok=True)
    clean, crowded, true = work / "clean-images", work / "people-images", work / "true"
    _populate(scene, truth.world_T_rigs, tall, seed, (clean, crowded, true))
    settings = RefineSettings(export=ExportSettings(formats=()))
    rows = []
    for name, images, masks in (
        ("clean", clean, None),
        ("clean, distractors looked for", clean, "distractors"),
        ("people", crowded, None),
        ("people, distractors masked", crowded, "distractors"),
        ("people, true masks", crowded, true),
    ):
        out = work / name.replace(", ", "-").replace(" ", "-")
        result = refine(images, scene / "slam.tum", out, settings, masks=masks)
        errors = evaluate(read_trajectory(out / "trajectory.tum"), truth)
        numbers = _masks(result.frames, true if images is crowded else None) if masks else {}
        if steps:
            reconstruction, splat = result.reconstruction, out.with_name(f"{out.name}-splat")
            numbers["psnr"] = splat_psnr(
                reconstruction, result.frames, scan(clean), steps, splat, seed
            )
        rows.append(Row(name, errors.ate.rmse, errors.rpe_rotation_deg.median, **numbers))
    return rows


def _populate(
    scene: Path, world_T_rigs: np.ndarray, tall: float, seed: int, folders: Sequence[Path]
) -> None:
    """Write frames with noise, frames with noise and people, and masks that leave people out."""
    clean, crowded, true = folders
    frames = scan(scene / "images")
    up = -world_T_rigs[:, :3, 1].mean(axis=0)
    people = make_people(world_T_rigs, NUM_PEOPLE, tall, up / np.linalg.norm(up), seed)
    for f, name in enumerate(frames.names):
        file = frames.paths[f][0].name
        if (true / f"{name}.png").exists():  # the last that is written
            continue
        image = load_erp(frames, f)
        crowd, outline = paste_people(image, world_T_rigs[f], people, f)
        noise = np.random.default_rng([seed, f]).normal(0, NOISE_GREY, image.shape)
        for folder, pixels in ((clean, image), (crowded, crowd)):
            write_image(folder / file, np.clip(np.rint(pixels + noise), 0, 255).astype(np.uint8))
        write_image(true / f"{name}.png", np.where(outline, 0, 255).astype(np.uint8))
    for folder in (clean, crowded):
        shutil.copy(scene / "images" / "timestamps.csv", folder)


def mean_rows(draws: Sequence[Sequence[Row]]) -> list[Row]:
    """Mean rows over several seeds."""

    def mean(column: str, rows: Sequence[Row]) -> float | None:
        values = [getattr(row, column) for row in rows]
        return None if None in values else float(np.mean(values))

    columns = [column for column in Row.__slots__ if column != "name"]
    return [
        Row(rows[0].name, *(mean(column, rows) for column in columns))
        for rows in zip(*draws, strict=True)
    ]


def splat_psnr(
    reconstruction: Reconstruction,
    frames: FrameSet,
    clean: FrameSet,
    steps: int,
    out: Path,
    seed: int,
) -> float:
    """PSNR of a splat trained on a run's masked frames, against held-out frames without people."""
    settings = SplatSettings(
        iterations=steps,
        face_size=FACE_SIZE,
        sh_degree=1,
        max_gaussians=40_000,
        backend="cpu",
        seed=seed,
    )
    split = split_frames(refined_frames(reconstruction), settings.held_out_every)
    poses, backend = reconstruction.world_T_rigs, choose_backend("cpu", 2)
    seen = load_faces(frames, split.training, FACE_SIZE)
    unseen = load_faces(clean, split.held_out, FACE_SIZE)
    source = PosedViews.of(poses, split, seen, unseen)
    files = fingerprint([*(p[0] for p in frames.paths), *frames.mask_paths])
    key = digest(files, poses.tolist(), settings)
    _, found = train_and_measure(reconstruction, frames, source, settings, backend, out, key)
    return found.mean.psnr


def _masks(frames: FrameSet, true_masks: Path | None) -> dict[str, float]:
    """Recall and false share of a run's masks by the true masks of people."""
    inter = union = true_sum = false = masked = 0.0
    for f, name in enumerate(frames.names):
        mask = load_mask(frames, f)
        found = (
            np.zeros((frames.format.height, frames.format.width), bool) if mask is None else ~mask
        )
        masked += found.mean()
        if true_masks is not None:
            size = frames.format.width, frames.format.height
            true = decode(true_masks / f"{name}.png", size, gray=True) <= 127
            inter, union = inter + np.sum(found & true), union + np.sum(found | true)
            true_sum, false = true_sum + np.sum(true), false + np.mean(found & ~true)
    numbers = {"masked": masked / len(frames)}
    if true_masks is not None:
        numbers |= {"iou": inter / union, "recall": inter / true_sum, "false": false / len(frames)}
    return {key: float(value) for key, value in numbers.items()}


def carrier_rows(frames: FrameSet, work: Path) -> list[Row]:
    """Rows of a bag and a stick pasted into a walk, fixed in the image and rotating below it."""
    rng = np.random.default_rng(0)
    height, width = frames.format.height, frames.format.width
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


def apartment_row(folder: Path) -> Row:
    """Row of a real capture's carrier against a hand-drawn outline; recall is of low rows."""
    frames = find_panoramas(folder / "images")
    corners = np.loadtxt(OUTLINE, delimiter=",") * (frames.format.width / OUTLINE_WIDTH)
    drawn = np.zeros((frames.format.height, frames.format.width), np.uint8)
    true = cv2.fillPoly(drawn, [np.rint(corners).astype(np.int32)], 1) > 0
    carrier = find_carrier(frames)
    found = np.stack([~carrier_mask(carrier, frames, f) for f in range(len(frames))])
    low = slice(round(LOW_ROWS * frames.format.height), None)
    return Row(
        "carrier, apartment",
        masked=carrier.share,
        iou=float(np.sum(found & true) / np.sum(found | true)),
        recall=float(np.sum((found & true)[:, low]) / (len(frames) * np.sum(true[low]))),
        false=float(np.sum(found & ~true) / (len(frames) * np.sum(~true))),
    )


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
    """Targets that are missed."""
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
        if row.name == "carrier, apartment" and (row.recall or 0) < MIN_CARRIER:
            out.append(f"{row.name}: {row.recall:.1%} of it found")
        if row.name == "carrier, apartment" and (row.false or 0) > MAX_REST:
            out.append(f"{row.name}: {row.false:.1%} of the rest masked")
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of scenes; none: render the gallery")
    parser.add_argument("--scene", default="aisle_loop")
    parser.add_argument("--tall", type=float, default=0.4, help="height of a person, map units")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
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
    seeds = arguments.seeds
    draws = [people_rows(scene, work / f"seed{n}", tall, arguments.splat, n) for n in seeds]
    rows = mean_rows(draws)
    rows += carrier_rows(find_panoramas(scene / "images"), work)
    if arguments.data is not None and (arguments.data / "apartment" / "images").is_dir():
        rows.append(apartment_row(arguments.data / "apartment"))
    misses = missed(rows)
    verdict = "; ".join(misses) or "all targets hold"
    text = f"{scene.name}, {len(seeds)} draws, {machine()}\n\n{table(rows)}\n\n{verdict}\n"
    print(text)
    if arguments.markdown:
        arguments.markdown.write_text(text)
    if arguments.json:
        values, *each = ([asdict(row) for row in some] for some in (rows, *draws))
        content = {"scene": scene.name, "rows": values, "draws": each}
        arguments.json.write_text(json.dumps(content, indent=1))
    return 1 if misses else 0


if __name__ == "__main__":
    sys.exit(main())
