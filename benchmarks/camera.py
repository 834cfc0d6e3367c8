"""Errors by two lenses and their rolling shutter, without and with a camera model of these.

    python -m benchmarks.camera WALK... --out WORK [--seeds 0 1 2] [--peer] [--markdown FILE]

A WALK is a folder of panoramas with exact truth: `images/` with timestamps.csv, `groundtruth.tum`,
`slam.tum` (made from the truth with drift if it is absent) and, to check the estimated camera,
`calibration.json` with the lenses' `rig_T_lens`, `readout_s` and `stitch_radius`. Each is refined
with one centre (`central`) and with two lenses if images show them (`auto`, the baseline given;
without and with the photometric family), with every seed, and by the peer's spherical incremental
mode. Errors are root mean squares.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import (
    Case,
    code_digest,
    digest,
    kept_row,
    refine_command,
    run_row,
    write_table,
)
from gsba.demo.degrade import degrade
from gsba.evaluate.consistency import consistency_of
from gsba.evaluate.trajectory import evaluate
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

TIMEOUT_S = 3600.0
WAYS = {
    "central": ["--set", "camera.model=central"],
    "auto": [],
    "auto, photometric": ["--factors", "bearing,photometric"],
}  # -> options
COLUMNS = (
    ("ate", "ATE 1e-3", 1e3, ".2f"),
    ("rpe", "RPE 1e-3", 1e3, ".2f"),
    ("rotation", "rel. rot. °", 1.0, ".4f"),
    ("rotation_claims", "error/σ rot.", 1.0, ".2f"),
    ("position_claims", "error/σ pos.", 1.0, ".2f"),
    ("baseline_off", "baseline off %", 100.0, "+.2f"),
    ("readout_off", "readout off %", 100.0, "+.1f"),
    ("scale_off", "metres off %", 100.0, "+.2f"),
    ("scale_sigmas", "in σ", 1.0, "+.1f"),
    ("cpu_s", "CPU s", 1.0, ".1f"),
)


def case_of(walk: Path, work: Path) -> Case:
    """Walk, whose coarse trajectory is made in `work` if it has none."""
    slam = walk / "slam.tum"
    if not slam.exists():
        slam = work / walk.name / "slam.tum"
        slam.parent.mkdir(parents=True, exist_ok=True)
        write_tum(slam, degrade(read_trajectory(walk / "groundtruth.tum"), seed=1))
    return Case(walk / "images", slam, walk / "groundtruth.tum")


def true_camera(walk: Path) -> dict[str, float]:
    """True baseline, in units of the truth, and readout time, as far as they are known."""
    path = walk / "calibration.json"
    if not path.exists():
        return {}
    content = json.loads(path.read_text())
    front, back = (np.array(content["lenses"][name]["rig_T_lens"]) for name in ("front", "back"))
    baseline = float(np.linalg.norm(front[:3, 3] - back[:3, 3]))
    return {"baseline": baseline, "readout_s": content["readout_s"]}


def judged(run: Path, truth: Trajectory, camera: dict[str, float]) -> dict[str, Any]:
    """Errors of a run's poses and of its estimated camera."""
    errors = evaluate(read_trajectory(run / "trajectory.tum"), truth)
    reconstruction, frames = load_run(run)
    claims = consistency_of(reconstruction, frames.timestamps, truth).absolute
    row: dict[str, Any] = {
        "ate": errors.ate.rmse,
        "rpe": errors.rpe_translation.rmse,
        "rotation": errors.rpe_rotation_deg.rmse,
        "rotation_claims": claims.rotation.value,
        "position_claims": claims.position.value,
    }
    found = json.loads((run / "report.json").read_text()).get("camera") or {}
    row["taken"] = bool(found.get("taken"))
    if not row["taken"] or not camera.get("baseline"):
        return {"errors": row}
    row["baseline_off"] = errors.scale * found["baseline"] / camera["baseline"] - 1
    if "metres_per_unit" in found:
        row["scale_off"] = found["metres_per_unit"] / errors.scale - 1
        off = found["metres_per_unit"] - errors.scale
        row["scale_sigmas"] = off / found["metres_per_unit_sigma"]
    if found["readout"]["taken"] and camera["readout_s"]:
        row["readout_off"] = 1e-3 * found["readout"]["ms"] / camera["readout_s"] - 1
    return {"errors": row}


def judged_peer(out: Path, truth: Trajectory) -> dict[str, Any]:
    """Errors of a peer's poses, whose times are the numbers of frames."""
    found = read_trajectory(out / "trajectory.tum")
    rows = np.rint(found.timestamps).astype(int)
    timed = Trajectory(truth.timestamps[rows], found.world_T_rigs)
    errors = evaluate(timed, truth)
    row = {"ate": errors.ate.rmse, "rpe": errors.rpe_translation.rmse}
    return {"errors": row | {"rotation": errors.rpe_rotation_deg.rmse, "posed": len(rows)}}


def rows_of(walk: Path, work: Path, seeds: list[int], peer: bool) -> list[tuple[str, list[dict]]]:
    """Outcomes of each method on a walk."""
    case, camera = case_of(walk, work), true_camera(walk)
    truth, seen = read_trajectory(case.truth), digest(sorted(case.images.iterdir()))
    assert case.trajectory is not None
    found: list[tuple[str, list[dict]]] = []
    for name, own in WAYS.items():
        outcomes = []
        for seed in seeds:
            run = work / walk.name / f"{name.replace(', ', '-')}-{seed}"
            options = [str(case.trajectory), "--set", f"seed={seed}", *own]
            if camera.get("baseline"):
                options += ["--set", f"camera.baseline_mm={1e3 * camera['baseline']}"]
            key = {"code": code_digest(), "frames": seen, "options": options}
            row = kept_row(run.parent / f"{run.name}.row", key, TIMEOUT_S)
            outcomes.append(
                row
                or run_row(
                    refine_command(case.images, run, options),
                    run.parent / f"{run.name}.row",
                    {"key": key},
                    lambda run=run: judged(run, truth, camera),
                    TIMEOUT_S,
                )
            )
        found.append((name, outcomes))
    if peer:
        out = work / walk.name / "peer"
        script = Path(__file__).with_name("peer.py")
        command = [sys.executable, str(script), "spherical-incremental", str(case.images), str(out)]
        key = {"peer": "spherical-incremental", "frames": seen}
        row = kept_row(out.with_suffix(".row"), key, TIMEOUT_S)
        finish = lambda: judged_peer(out, truth)  # noqa: E731
        row = row or run_row(command, out.with_suffix(".row"), {"key": key}, finish, TIMEOUT_S)
        found.append(("pycolmap.panorama", [row]))
    return found


def cell(outcomes: list[dict], name: str, factor: float, form: str) -> str:
    """Median of the outcomes, and their range if there are several."""
    values = [
        factor * (row[name] if name in row else row["errors"][name])
        for row in outcomes
        if name in row or name in row.get("errors", {})
    ]
    if not values:
        return "–"
    middle = format(float(np.median(values)), form)
    if len(values) == 1:
        return middle
    return f"{middle} ({format(min(values), form)} to {format(max(values), form)})"


def main() -> None:
    """Run the chosen rows and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--peer", action="store_true")
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    names = ["walk", "as", "taken", *(title for _, title, *_ in COLUMNS)]
    lines = [f"| {' | '.join(names)} |", "|---|---|" + "---:|" * (len(names) - 2)]
    for walk in arguments.walks:
        for name, outcomes in rows_of(walk, arguments.out, arguments.seeds, arguments.peer):
            for row in outcomes:
                if "reason" in row:
                    print(f"{walk.name} {name}: {row['reason']}")
            taken = [row.get("errors", {}).get("taken") for row in outcomes]
            sure = name not in WAYS or name == "central"
            times = "–" if sure else f"{sum(map(bool, taken))} of {len(taken)}"
            cells = [cell(outcomes, key, factor, form) for key, _, factor, form in COLUMNS]
            lines.append(f"| `{walk.name}` | {name} | {times} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    print("\n".join(lines))
    write_table(lines, arguments.markdown)


if __name__ == "__main__":
    main()
