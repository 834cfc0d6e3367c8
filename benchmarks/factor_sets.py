"""Accuracy by sets of observations: bearings, aligned patches, and families by their names.

`bearing` has the features that `aligned` starts from; `tuned bearing` has the finer ones of
`--config bearing`, the best configuration without patches.

    python benchmarks/factor_sets.py --data DATA --sequences aisle_loop,demo_rectangle --out WORK

`--families photometric,barometer:{walk}/heights.csv` adds rows of `aligned` with each of these
families beside it, gsba's own or a package's, as `gsba refine --factors` names them; {walk} stands
for the folder of the sequence.

Every sequence is refined from several coarse trajectories, one for each seed, with every set.
Sequences are folders of `--data` with `images/`, `groundtruth.tum` and, for induced errors,
`depth/`; or demo walks, rendered into WORK. `--disturb` changes the images first. Runs are kept in
WORK and resumed.
"""

import argparse
import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from common import machine

from gsba import refine
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.demo import make_walk
from gsba.demo.degrade import degrade
from gsba.disk import write_text
from gsba.evaluate.pixels import depth_maps, induced_errors
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory, write_tum

WALKS = {
    "demo_rectangle": ("rectangle", "locked"),
    "demo_oval": ("oval", "forward"),
    "demo_open": ("open", "forward"),
}
TUNED = Path("bearing")  # the best without patches
DISTURBANCES = ("none", "exposure", "blur", "objects")


@dataclass(frozen=True, slots=True)
class Row:
    """One refinement."""

    sequence: str
    disturbance: str
    start: str  # seed of the coarse trajectory, or its file
    factors: str
    ate: float  # units of the truth, after Sim(3)
    rotation_deg: float  # median between consecutive frames
    induced_px: float | None  # median; None without depth
    induced95_px: float | None
    align_cpu_s: float  # of alignment and its bundle adjustments
    cpu_s: float  # of all stages


def find_walk(name: str, data: Path, out: Path) -> Path:
    """Folder of a sequence with `images/` and `groundtruth.tum`.

    Raises:
        GsbaError: the sequence is not on this machine.
    """
    if name in WALKS:
        folder = out / name / "walk"
        if not folder.exists():
            path, heading = WALKS[name]
            folder.parent.mkdir(parents=True, exist_ok=True)
            make_walk(folder, path, heading, depth=True)  # type: ignore[arg-type]
        return folder
    if not (data / name / "groundtruth.tum").exists():
        raise GsbaError(f"{data / name} holds no groundtruth.tum: skipped")
    return data / name


def disturbed(images: Path, how: str, folder: Path, seed: int = 0) -> Path:
    """Copies of the frames with changed exposure, blur, or moving rectangles pasted in.

    exposure: gain and offset of up to 20% of full scale each; blur: every third frame, sigma of
    2 pixels; objects: textured rectangles that move, on 5% of the image.
    """
    if how == "none":
        return images
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    objects = [rng.integers(0, 255, (8, 8, 3), dtype=np.uint8) for _ in range(5)]
    drift = rng.uniform(-30, 30, (5, 2))
    for f, path in enumerate(sorted(images.iterdir())):
        if path.suffix.lower() not in (".jpg", ".png"):
            shutil.copy(path, folder)
            continue
        image = cv2.imread(str(path))
        assert image is not None
        height, width = image.shape[:2]
        if how == "exposure":
            gain, offset = rng.uniform(0.8, 1.2), rng.uniform(-0.2, 0.2) * 255 * 0.25
            image = np.clip(gain * image.astype(np.float32) + offset, 0, 255).astype(np.uint8)
        elif how == "blur" and f % 3 == 0:
            image = cv2.GaussianBlur(image, (0, 0), 2.0)
        elif how == "objects":
            side = int(np.sqrt(0.01 * height * width))
            for k, texture in enumerate(objects):
                row = int(height * (0.3 + 0.08 * k) + drift[k, 1] * f) % (height - side)
                column = int(width * k / 5 + drift[k, 0] * f) % (width - side)
                pasted = cv2.resize(texture, (side, side), interpolation=cv2.INTER_CUBIC)
                image[row : row + side, column : column + side] = pasted
        cv2.imwrite(str(folder / path.name), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def with_family(settings: RefineSettings, family: str, walk: Path) -> RefineSettings:
    """Settings with one more family, named as in settings.factors.

    Raises:
        ValueError: the family is not installed.
    """
    factors = (*settings.factors, family.replace("{walk}", str(walk)))
    return RefineSettings.model_validate(settings.model_dump() | {"factors": factors})


def run_case(
    name: str,
    walk: Path,
    images: Path,
    how: str,
    start: Path,
    out: Path,
    settings: RefineSettings,
    families: Sequence[str] = (),
) -> Iterable[Row]:
    """Refine with each set; `aligned` reuses the stages of `bearing`."""
    truth = read_trajectory(walk / "groundtruth.tum")
    plain = settings.patches.model_copy(update={"rounds": 0})
    sets = {
        "tuned bearing": (load_config(TUNED), out.with_name(f"{out.name}-tuned")),
        "bearing": (settings.model_copy(update={"patches": plain}), out),
        "aligned": (settings, out),
    }
    for family in families:
        folder = out.with_name(f"{out.name}-{family.partition(':')[0]}")
        sets[family] = with_family(settings, family, walk), folder
    for factors, (chosen, run) in sets.items():
        export = chosen.export.model_copy(update={"formats": ()})
        result = refine(images, start, run, chosen.model_copy(update={"export": export}))
        found = read_trajectory(run / "trajectory.tum")
        errors = evaluate(found, truth)
        induced = None
        if (walk / "depth").exists():
            ranges = depth_maps(walk / "depth", len(truth.timestamps))
            induced = induced_errors(found, truth, ranges, result.frames.format.width)
        stages = result.report["stages"]
        patches = [s["cpu_seconds"] for s in stages if s["name"].startswith("align")]
        yield Row(
            name,
            how,
            start.stem,
            factors,
            errors.ate.rmse,
            errors.rpe_rotation_deg.median,
            induced and induced.median_px,
            induced and induced.percentile95_px,
            sum(patches),
            sum(stage["cpu_seconds"] for stage in stages),
        )


def to_markdown(rows: Sequence[Row]) -> str:
    """Medians over the starts, a line for each sequence, disturbance and set."""
    lines = [
        "| sequence | images | factors | starts | ATE, 1e-3 units | rel. rot. ° | induced px "
        "| 95% | patches CPU s | all CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for key in dict.fromkeys((row.sequence, row.disturbance, row.factors) for row in rows):
        group = [row for row in rows if (row.sequence, row.disturbance, row.factors) == key]

        def median(field: str, group: list[Row] = group) -> float:
            values = [getattr(row, field) for row in group]
            return float("nan") if None in values else float(np.median(values))

        lines.append(
            f"| {' | '.join(key)} | {len(group)} | {1e3 * median('ate'):.2f} "
            f"| {median('rotation_deg'):.4f} | {median('induced_px'):.4f} "
            f"| {median('induced95_px'):.3f} | {median('align_cpu_s'):.1f} "
            f"| {median('cpu_s'):.1f} |"
        )
    return "\n".join([*lines, "", f"Medians over the starts. {machine()}.", ""])


def main() -> None:
    """Run the chosen sequences and print the table."""
    parser = argparse.ArgumentParser(description="Bearings alone against aligned patches.")
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--sequences", default="aisle_loop,gallery_forward,demo_rectangle")
    parser.add_argument("--starts", default="0,1,2", help="seeds, or files of the sequence")
    parser.add_argument("--families", default="", help="beside aligned: NAME or NAME:ARGUMENT, ...")
    parser.add_argument("--disturb", default="none", help=f"of {','.join(DISTURBANCES)}")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--out", type=Path, default=Path("factor_sets"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    settings, rows = load_config(options.config), []
    families = [name for name in options.families.split(",") if name]
    for name in options.sequences.split(","):
        try:
            walk = find_walk(name, options.data, options.out)
        except GsbaError as error:
            print(error)
            continue
        truth = read_trajectory(walk / "groundtruth.tum")
        for how in options.disturb.split(","):
            images = disturbed(walk / "images", how, options.out / name / how / "images")
            for start in options.starts.split(","):
                path = walk / start
                if start.isdecimal():
                    path = options.out / name / f"seed{start}.tum"
                    path.parent.mkdir(parents=True, exist_ok=True)
                    write_tum(path, degrade(truth, int(start)))
                out = options.out / name / how / f"run_{path.stem}"
                for row in run_case(name, walk, images, how, path, out, settings, families):
                    rows.append(row)
                    print(row, flush=True)
                    if options.json is not None:
                        text = json.dumps([asdict(row) for row in rows], indent=1)
                        write_text(options.json, text)
    table = to_markdown(rows)
    print(table)
    if options.markdown is not None:
        write_text(options.markdown, table)


if __name__ == "__main__":
    main()
