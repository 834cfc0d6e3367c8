"""Accuracy on raw fisheyes by the known calibration, beside COLMAP on the same files.

    python -m benchmarks.raw_fisheyes WALK... --out WORK [--seeds 0 1] [--peer [MODE...]]
        [--markdown FILE]

A WALK is a folder with exact truth: `front/`, `back/` and timestamps.csv (all three beside each
other or in `images/`), `groundtruth.tum`, `calibration.json` with the true lenses, and `slam.tum`
(made from the truth with drift if it is absent). Rows: `known`, with that calibration; `nominal`,
with errors of 3 % in focal length, without distortion, of 4 pixels in principal points, and of
1 degree and 5 mm in the back lens; `nothing`, without a calibration; `stitched`, the panoramas of
the same walk, if it has them. The peer gets the true calibration, and in half of its rows the
trajectory, in metres (`benchmarks/raw_peer.py`).

Errors are root mean squares, of the middle between the lenses. The rotation between raw images and
the rig's axes is unknown, so that the best constant rotation of the rig is removed first in every
row, the peer's too, if it makes steps more similar to the true ones.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.camera import TIMEOUT_S, case_of, cell, judged, true_camera
from benchmarks.common import code_digest, digest, kept_row, refine_command, run_row, write_table
from benchmarks.raw_peer import MODES
from gsba.camera.calibration import read_calibration
from gsba.camera.fisheye import Rig, project, rotation_of, unproject
from gsba.evaluate.trajectory import evaluate
from gsba.geometry import nearest_rotation, rotation_angle
from gsba.similarity import similarity
from gsba.trajectory.association import matched_in_time
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

PEER = Path(__file__).with_name("raw_peer.py")
WAYS = ("known", "nominal", "nothing", "stitched")
COLUMNS = (
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


def judged_run(run: Path, truth: Trajectory, calibration: Path) -> dict[str, Any]:
    """Errors of a run's poses and of its estimated lenses."""
    estimate = read_trajectory(run / "trajectory.tum")
    camera = true_camera(calibration.parent)
    errors = judged(run, in_axes_of(estimate, truth), camera)["errors"]
    errors["posed"] = len(estimate.timestamps)
    if (run / "calibration.json").exists():
        found = read_calibration(run / "calibration.json")
        errors |= lens_errors(found, read_calibration(calibration))
    return {"errors": errors}


def judged_peer(out: Path, truth: Trajectory) -> dict[str, Any]:
    """Errors of the peer's poses, without and with a trajectory, each with its own cost."""
    parts = {}
    for name, cost in json.loads((out / "costs.json").read_text()).items():
        parts[name] = {"cost": cost, "reason": "found no model"}
        if (out / f"{name}.tum").exists():
            estimate = read_trajectory(out / f"{name}.tum")
            found = evaluate(estimate, in_axes_of(estimate, truth))
            errors = {"ate": found.ate.rmse, "rpe": found.rpe_translation.rmse}
            errors |= {"rotation": found.rpe_rotation_deg.rmse, "posed": len(estimate.timestamps)}
            parts[name] = {"cost": cost, "errors": errors}
    return {"errors": {}, "parts": parts}


def rows_of(
    walk: Path, work: Path, seeds: list[int], ways: list[str]
) -> Iterator[tuple[str, list[dict]]]:
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
    for name in ways:
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


def peers_of(walk: Path, work: Path, modes: Sequence[str]) -> Iterator[tuple[str, list[dict]]]:
    """Yield outcomes of the peer's modes on a walk that `rows_of` has prepared."""
    home, known = work / walk.name, walk / "calibration.json"
    truth = between_lenses(read_trajectory(walk / "groundtruth.tum"), known)
    coarse = case_of(walk, work).trajectory
    assert coarse is not None
    start = scaled(coarse, truth, home / "slam_metres.tum")
    seen = digest([PEER, known, start, *sorted((home / "frames").glob("*/*"))])
    for mode in modes:
        out, folder = home / f"peer-{mode}", home / f"peer-{mode}.row"
        command = [sys.executable, str(PEER), mode, str(home / "frames"), str(known), str(out)]
        key = {"peer": mode, "frames": seen}
        row = kept_row(folder, key, TIMEOUT_S)
        if row is None:
            shutil.rmtree(out, ignore_errors=True)
            finish = _finish_peer(out, truth)
            row = run_row(
                [*command, "--start", str(start)], folder, {"key": key}, finish, TIMEOUT_S
            )
        yield from _parts(f"pycolmap, {mode}", row)


def _parts(title: str, row: dict) -> Iterator[tuple[str, list[dict]]]:
    """Yield the two rows of a run of the peer; the cost of each excludes the other's own steps."""
    for name, part in sorted(row.get("parts", {"alone": row}).items()):
        others = [other["cost"] for key, other in row.get("parts", {}).items() if key != name]
        cost = {of: row[of] - sum(other[of] for other in others) for of in ("wall_s", "cpu_s")}
        yield f"{title}{'' if name == 'alone' else f', {name}'}", [part | cost]


def scaled(trajectory: Path, truth: Trajectory, path: Path) -> Path:
    """Write a trajectory in metres, the unit of the truth, which a rig of known size needs."""
    found = read_trajectory(trajectory)
    poses = found.world_T_rigs.copy()
    poses[:, :3, 3] *= evaluate(found, truth).scale
    write_tum(path, Trajectory(found.timestamps, poses))
    return path


def _finish_peer(out: Path, truth: Trajectory):
    return lambda: judged_peer(out, truth)


def _finish(run: Path, truth: Trajectory, known: Path):
    return lambda: judged_run(run, truth, known)


def main() -> None:
    """Run the chosen rows and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("walks", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--ways", nargs="*", choices=WAYS, default=list(WAYS))
    parser.add_argument("--peer", nargs="*", choices=MODES, metavar="MODE", help="none named: all")
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    names = ["walk", "as", *(title for _, title, *_ in COLUMNS)]
    lines = [f"| {' | '.join(names)} |", "|---|---|" + "---:|" * (len(names) - 2)]
    for walk in (path.resolve() for path in arguments.walks):
        found = list(rows_of(walk, arguments.out, arguments.seeds, arguments.ways))
        if arguments.peer is not None:
            found += peers_of(walk, arguments.out, arguments.peer or MODES)
        for name, outcomes in found:
            reasons = {row["reason"] for row in outcomes if "reason" in row}
            title = ": ".join([name, *sorted(reasons)]).replace("|", "/")
            cells = [cell(outcomes, key, factor, form) for key, _, factor, form in COLUMNS]
            lines.append(f"| `{walk.name}` | {title} | {' | '.join(cells)} |")
    print("\n".join(lines))
    write_table(lines, arguments.markdown)


if __name__ == "__main__":
    main()
