"""Errors by two lenses and their rolling shutter, without and with a camera model of these.

    python benchmarks/camera.py WALK... --out WORK [--seeds 0 1 2] [--peer] [--markdown FILE]

A WALK is a folder of panoramas with exact truth: `images/` with timestamps.csv, `groundtruth.tum`,
`slam.tum` (made from the truth with drift if it is absent) and, to check the estimated camera,
`calibration.json` with the lenses' `rig_T_lens`, `readout_s` and `stitch_radius`. Each is refined
with one centre (`central`) and with two lenses if images show them (`auto`, the baseline given;
without and with the photometric family), with every seed, and by the peer's spherical incremental
mode. Errors are root mean squares.

`--raw`: a WALK has `front/` and `back/` as well (beside `images/` or in it), refined `known`, with
the true calibration; `nominal`, with errors of 3 % in focal length, without distortion, of 4 pixels
in principal points, and of 1 degree and 5 mm in the back lens; `nothing`, without a calibration;
and `stitched`, the panoramas, if the walk has them. Errors are those of the middle between the
lenses, after the best constant rotation of the rig, if that makes steps more similar to the true
ones: the rotation between raw images and the rig's axes is unknown.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from common import (
    Case,
    code_digest,
    digest,
    kept_row,
    refine_command,
    run_row,
    write_table,
)

from gsba.camera.calibration import read_calibration
from gsba.camera.fisheye import Rig, project, rotation_of, unproject
from gsba.demo.degrade import degrade
from gsba.evaluate.consistency import consistency_of
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import nearest_rotation, rotation_angle
from gsba.similarity import similarity
from gsba.store.finished import load_run
from gsba.trajectory.association import matched_in_time
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
RAW_WAYS = ("known", "nominal", "nothing", "stitched")
RAW_COLUMNS = (
    ("posed", "posed", 1.0, ".0f"),
    ("ate", "ATE 1e-3", 1e3, ".2f"),
    ("rpe", "RPE 1e-3", 1e3, ".2f"),
    ("rotation", "rel. rot. °", 1.0, ".4f"),
    ("rotation_claims", "error/σ rot.", 1.0, ".2f"),
    ("position_claims", "error/σ pos.", 1.0, ".2f"),
    ("focal_off", "focal off %", 100.0, "+.2f"),
    ("turn_off", "back lens turned °", 1.0, ".3f"),
    ("direction_off", "worst direction °", 1.0, ".3f"),
    ("baseline_off", "baseline off %", 100.0, "+.2f"),
    ("readout_off", "readout off %", 100.0, "+.1f"),
    ("cpu_s", "CPU s", 1.0, ".1f"),
    ("wall_s", "wall s", 1.0, ".1f"),
)
_FOCAL, _PRINCIPAL = 0.97, (-3.0, 2.6)  # of a nominal calibration: factor, pixels
_TURN_DEG, _TURN_AXIS = 1.0, (0.42, 1.0, 0.40)  # of its back lens, in the rig
_MOVE_M = (3.0e-3, 3.2e-3, 2.4e-3)
_WORST_DEG = 95.0  # largest angle from the axis at which directions are compared


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


def linked(walk: Path, folder: Path) -> Path:
    """Folder with links to the raw images of a walk and their times only."""
    home = next(home for home in (walk / "images", walk) if (home / "front").is_dir())
    shutil.rmtree(folder, ignore_errors=True)
    for name in ("front", "back"):
        (folder / name).mkdir(parents=True)
        for path in sorted((home / name).iterdir()):
            (folder / name / path.name).symlink_to(path.resolve())
    times = [home / "timestamps.csv", walk / "images" / "timestamps.csv"]
    found = next((path for path in times if path.exists()), None)
    if found is None:
        raise SystemExit(f"{walk} has no timestamps.csv: put one beside its images")
    shutil.copyfile(found, folder / "timestamps.csv")
    return folder


def nominal(truth: Path, path: Path) -> Path:
    """Write a nominal calibration, like a data sheet's, of a camera with calibration `truth`."""
    from scipy.spatial.transform import Rotation

    content = json.loads(truth.read_text())
    for lens in content["lenses"].values():
        lens |= {"f": _FOCAL * lens["f"], "k": [0.0]}
        lens |= {"cx": lens["cx"] + _PRINCIPAL[0], "cy": lens["cy"] + _PRINCIPAL[1]}
    back = content["lenses"]["back"]
    rig_T_back = np.array(back["rig_T_lens"])
    axis = np.array(_TURN_AXIS) / np.linalg.norm(_TURN_AXIS)
    turn = Rotation.from_rotvec(np.deg2rad(_TURN_DEG) * axis).as_matrix()
    rig_T_back[:3, :3] = turn @ rig_T_back[:3, :3]
    rig_T_back[:3, 3] += _MOVE_M
    back["rig_T_lens"] = rig_T_back.tolist()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1))
    return path


def between_lenses(truth: Trajectory, calibration: Path) -> Trajectory:
    """True poses of the middle between the lenses, which may differ from the files' rig."""
    lenses = json.loads(calibration.read_text())["lenses"]
    centres = [np.array(lenses[name]["rig_T_lens"])[:3, 3] for name in ("front", "back")]
    poses = truth.world_T_rigs.copy()
    poses[:, :3, 3] += poses[:, :3, :3] @ np.mean(centres, axis=0)
    return Trajectory(truth.timestamps, poses)


def in_axes_of(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """Truth in a rig that is rotated by the best constant rotation for an estimate, whose world is
    aligned by positions; unchanged if the steps' rotations are more similar without it."""
    rows_e, rows_t = matched_in_time(estimate, truth, 0.01)
    poses, true_poses = estimate.world_T_rigs[rows_e], truth.world_T_rigs[rows_t]
    world = similarity(poses[:, :3, 3], true_poses[:, :3, 3]).rotation
    rotations = world @ poses[:, :3, :3]
    turn = nearest_rotation((np.swapaxes(true_poses[:, :3, :3], 1, 2) @ rotations).sum(axis=0))
    turned = truth.world_T_rigs.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ turn
    both = truth, Trajectory(truth.timestamps, turned)
    return min(both, key=lambda one: evaluate(estimate, one).rpe_rotation_deg.rmse)


def lens_errors(found: Rig, truth: Rig) -> dict[str, float]:
    """Errors of estimated lenses: larger relative error of the focal length, rotation of the back
    lens against the front one, degrees, and largest error of a direction, degrees."""
    focal = [a.focal / b.focal - 1 for a, b in zip(found, truth, strict=True)]
    front_R_backs = [rotation_of(pair[0]).T @ rotation_of(pair[1]) for pair in (found, truth)]
    angles, around = np.meshgrid(
        np.deg2rad(np.linspace(0, _WORST_DEG, 96)), np.linspace(0, 2 * np.pi, 73)[:-1]
    )
    across = np.sin(angles)
    local = np.stack([across * np.cos(around), across * np.sin(around), np.cos(angles)], axis=-1)
    ours, theirs = [], []
    for a, b in zip(found, truth, strict=True):
        directions = local @ rotation_of(b).T
        theirs.append(directions)
        ours.append(unproject(a, project(b, directions)))
    one, other = np.array(ours), np.array(theirs)
    common = nearest_rotation(np.einsum("lij,lija,lijb->ab", [across, across], other, one))
    apart = np.linalg.norm(other - one @ common.T, axis=-1)
    return {
        "focal_off": max(focal, key=abs),
        "turn_off": float(np.rad2deg(rotation_angle(front_R_backs[0].T @ front_R_backs[1]))),
        "direction_off": float(np.rad2deg(2 * np.arcsin(apart.max() / 2))),
    }


def judged_raw(run: Path, truth: Trajectory, calibration: Path) -> dict[str, Any]:
    """Errors of a run's poses and of its estimated lenses."""
    estimate = read_trajectory(run / "trajectory.tum")
    camera = true_camera(calibration.parent)
    errors = judged(run, in_axes_of(estimate, truth), camera)["errors"]
    errors["posed"] = len(estimate.timestamps)
    if (run / "calibration.json").exists():
        found = read_calibration(run / "calibration.json")
        errors |= lens_errors(found, read_calibration(calibration))
    return {"errors": errors}


def raw_rows_of(walk: Path, work: Path, seeds: list[int]) -> Iterator[tuple[str, list[dict]]]:
    """Yield outcomes of each row on a walk."""
    home, case, known = work / walk.name, case_of(walk, work), walk / "calibration.json"
    raw = linked(walk, home / "frames")
    rough = nominal(known, home / "nominal.json")
    truth = between_lenses(read_trajectory(case.truth), known)
    millimetres = 1e3 * true_camera(walk)["baseline"]
    own = {
        "known": ["--calibration", str(known)],
        "nominal": ["--calibration", str(rough)],
        "nothing": [],
        "stitched": ["--set", f"camera.baseline_mm={millimetres}"],
    }
    panoramas = [path for path in case.images.glob("*") if path.suffix in (".jpg", ".png")]
    for name in RAW_WAYS:
        frames = case.images if name == "stitched" else raw
        if name == "stitched" and not panoramas:
            continue
        pictures = panoramas if name == "stitched" else sorted(raw.glob("*/*"))
        outcomes = []
        for seed in seeds:
            run = home / f"{name}-{seed}"
            options = [str(case.trajectory), "--set", f"seed={seed}", *own[name]]
            key = {"code": code_digest(), "options": options, "frames": digest(sorted(pictures))}
            folder, finish = run.parent / f"{run.name}.row", _finish(run, truth, known)
            row = kept_row(folder, key, TIMEOUT_S)
            command = refine_command(frames, run, options)
            outcomes.append(row or run_row(command, folder, {"key": key}, finish, TIMEOUT_S))
        yield name, outcomes


def _finish(run: Path, truth: Trajectory, known: Path):
    return lambda: judged_raw(run, truth, known)


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
    parser.add_argument("--peer", action="store_true", help="of panoramas only")
    parser.add_argument("--raw", action="store_true", help="refine the raw fisheyes")
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    columns = RAW_COLUMNS if arguments.raw else COLUMNS
    names = ["walk", "as", "two lenses", *(title for _, title, *_ in columns)]
    lines = [f"| {' | '.join(names)} |", "|---|---|" + "---:|" * (len(names) - 2)]
    for walk in (path.resolve() for path in arguments.walks):
        rows = (
            raw_rows_of(walk, arguments.out, arguments.seeds)
            if arguments.raw
            else rows_of(walk, arguments.out, arguments.seeds, arguments.peer)
        )
        for name, outcomes in rows:
            reasons = {row["reason"] for row in outcomes if "reason" in row}
            title = ": ".join([name, *sorted(reasons)]).replace("|", "/")
            taken = [row["errors"]["taken"] for row in outcomes if "taken" in row.get("errors", {})]
            cells = [cell(outcomes, key, factor, form) for key, _, factor, form in columns]
            cells = [f"{sum(taken)} of {len(outcomes)}" if taken else "–", *cells]
            lines.append(f"| `{walk.name}` | {title} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    print("\n".join(lines))
    write_table(lines, arguments.markdown)


if __name__ == "__main__":
    main()
