"""Residuals on the sphere or on cube faces: the same features, bundle-adjusted either way.

    python benchmarks/sphere_or_faces.py --data DATA --out WORK --markdown sphere_or_faces.md

Keypoints are found on cube faces in every row. `sphere` takes the angle between measured and
predicted ray as the residual, `faces` pixels on pinhole faces of one rig, `both` has both for each
observation. Rows come in two kinds: features alone, and with aligned patches.

Every sequence is refined from several coarse trajectories, one for each seed, with every row; each
run is a folder of its own in WORK, computed anew. Below the table, rows with the same sequence and
seed are compared. Starts of one sequence share its images, and end close to one another: they show
that the start does not matter, and are no further evidence. So there is no test of significance.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from common import machine
from factor_sets import find_walk

from gsba import refine
from gsba.config import RefineSettings
from gsba.demo.degrade import degrade
from gsba.disk import write_text
from gsba.evaluate.trajectory import evaluate
from gsba.log import GsbaError
from gsba.pipeline.stage_titles import title_of
from gsba.trajectory.files import read_trajectory, write_tum

RESIDUALS = {
    "sphere": ("bearing",),
    "faces": ("reprojection",),
    "both": ("bearing", "reprojection"),
}
KINDS = ("features alone", "with patches")


@dataclass(frozen=True, slots=True)
class Row:
    """One refinement."""

    sequence: str
    seed: int  # of the coarse trajectory
    kind: str
    residual: str
    ate: float  # units of the truth, after Sim(3)
    rotation_deg: float  # median between consecutive frames
    observations: int  # of the exported map
    solving_cpu_s: float  # of stages that adjust
    cpu_s: float  # of all stages


def settings_of(kind: str, residual: str) -> RefineSettings:
    """Settings of a row: defaults but for the residual and the patches."""
    settings = RefineSettings()
    patches = settings.patches
    if kind == KINDS[0]:
        patches = patches.model_copy(update={"rounds": 0})
    export = settings.export.model_copy(update={"formats": ()})
    changes = {"factors": RESIDUALS[residual], "patches": patches, "export": export}
    return settings.model_copy(update=changes)


def run_case(walk: Path, start: Path, out: Path, seed: int, kind: str, residual: str) -> Row:
    """Refine and compare with the truth.

    Raises:
        ValueError: patches were aligned in a row of features alone, or were not in another.
    """
    chosen = settings_of(kind, residual)
    report = refine(walk / "images", start, out, chosen, fresh=True).report
    truth, stages = read_trajectory(walk / "groundtruth.tum"), report["stages"]
    errors = evaluate(read_trajectory(out / "trajectory.tum"), truth)
    aligned = any(stage["name"].startswith("align") for stage in stages)
    if aligned != (kind == KINDS[1]):
        raise ValueError(f"{out}: patches {'were' if aligned else 'were not'} aligned")
    seconds = {stage["name"]: stage["cpu_seconds"] for stage in stages}
    return Row(
        walk.parent.name if walk.name == "walk" else walk.name,
        seed,
        kind,
        residual,
        errors.ate.rmse,
        errors.rpe_rotation_deg.median,
        report["summary"]["observations"],
        sum(s for name, s in seconds.items() if title_of(name).startswith("adjust")),
        sum(seconds.values()),
    )


def to_markdown(rows: Sequence[Row]) -> str:
    """Medians and ranges over the seeds, and comparisons of rows."""
    lines = [
        "| sequence | | residual | seeds | ATE, 1e-3 units: median (least, most) | rel. rot. ° "
        "| observations | solving CPU s | all CPU s |",
        "|---|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    for key in dict.fromkeys((row.sequence, row.kind, row.residual) for row in rows):
        group = [row for row in rows if (row.sequence, row.kind, row.residual) == key]
        ates = 1e3 * np.array([row.ate for row in group])
        medians = [
            float(np.median([getattr(row, name) for row in group]))
            for name in ("rotation_deg", "observations", "solving_cpu_s", "cpu_s")
        ]
        lines.append(
            f"| {' | '.join(key)} | {len(group)} | {np.median(ates):.2f} "
            f"({ates.min():.2f}, {ates.max():.2f}) | {medians[0]:.4f} | {medians[1]:.0f} "
            f"| {medians[2]:.1f} | {medians[3]:.1f} |"
        )
    lines += ["", *_comparisons(rows), "", f"{machine()}.", ""]
    return "\n".join(lines)


def _comparisons(rows: Sequence[Row]) -> list[str]:
    """Paired comparisons of `faces` and `both` with `sphere`, a line each."""
    found = {(row.kind, row.residual, row.sequence, row.seed): row.ate for row in rows}
    lines = []
    for kind in KINDS:
        pairs = [(s, n) for k, r, s, n in found if (k, r) == (kind, "sphere")]
        for other in ("faces", "both"):
            ratios = [
                found[kind, other, *pair] / found[kind, "sphere", *pair]
                for pair in pairs
                if (kind, other, *pair) in found
            ]
            if ratios:
                nearer = sum(ratio < 1 for ratio in ratios)
                lines.append(
                    f"- {kind}: `{other}` is nearer to the truth than `sphere` in {nearer} of "
                    f"{len(ratios)} pairs of rows; geometric mean of the ratios of ATE "
                    f"{np.exp(np.mean(np.log(ratios))):.2f}, from {min(ratios):.2f} to "
                    f"{max(ratios):.2f}"
                )
    return lines


def main() -> None:
    """Run the chosen sequences and print the table."""
    parser = argparse.ArgumentParser(description="Residuals on the sphere or on cube faces.")
    parser.add_argument("--data", type=Path, default=Path("data"))
    parser.add_argument("--sequences", default="aisle_loop,gallery_forward,demo_rectangle")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("sphere_or_faces"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    rows = []
    for seed in range(options.seeds):
        for name in options.sequences.split(","):
            try:
                walk = find_walk(name, options.data, options.out)
            except GsbaError as error:
                print(error)
                continue
            start = options.out / name / f"seed{seed}.tum"
            start.parent.mkdir(parents=True, exist_ok=True)
            write_tum(start, degrade(read_trajectory(walk / "groundtruth.tum"), seed))
            for kind in KINDS:
                for residual in RESIDUALS:
                    out = options.out / name / f"{kind.split()[0]}-{residual}-{seed}"
                    rows.append(run_case(walk, start, out, seed, kind, residual))
                    print(rows[-1], flush=True)
                    if options.json is not None:
                        text = json.dumps([asdict(row) for row in rows], indent=1)
                        write_text(options.json, text)
                    if options.markdown is not None:
                        write_text(options.markdown, to_markdown(rows))
    print(to_markdown(rows))


if __name__ == "__main__":
    main()
