"""Errors by what a camera does to pixels: each effect alone, none, and all together.

    python benchmarks/filmed.py --out WORK [--scenes gallery passage] [--seeds 0 1]
        [--effects ideal each all] [--starts trajectory none raw raw-none] [--peer]
        [--markdown FILE]

Walks through scenes of `gsba demo` are filmed by the camera of `filmed_camera.py`, with the motion
of real hands where that recording is on the machine. `ideal` has no effect, `each` stands for every
effect alone, `all` for those that one camera has, `a+b` for these two, `all+a` for one more, and
`all-a` for all but one. Each film is refined from a trajectory with drift and without any, and with
`--peer` by COLMAP's panorama mode. `--starts raw raw-none` refine the raw fisheyes of the same
camera by their true calibration, from that trajectory and without any: they are 32 mm apart, and
neither stabilised nor aligned at a seam. Films and rows are kept in WORK and used again while the
code and the film stay the same. Errors are root mean squares, except the induced pixel error
(median, of neighbouring frames).
"""

import argparse
import shutil
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from common import code_digest, digest, kept_row, refine_command, run_row, write_table
from filmed_camera import (
    ALL,
    EFFECTS,
    HAND_MOTION,
    NOT_IN_ALL,
    Camera,
    Hands,
    RawCamera,
    write_film,
)

from gsba.demo.degrade import degrade
from gsba.demo.gallery import build_gallery
from gsba.demo.raycast import Scene
from gsba.demo.walk import walk_poses
from gsba.evaluate.consistency import consistency_of
from gsba.evaluate.pixels import depth_maps, induced_errors
from gsba.evaluate.trajectory import evaluate
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import Trajectory

FRAMES, WIDTH = 44, 1024
TIMEOUT_S = 1800.0
SCENES = ("gallery", "passage")
STARTS = ("trajectory", "none")
RAW_STARTS = ("raw", "raw-none")
COLUMNS = (
    ("posed", "frames", 1.0, ".0f"),
    ("ate", "ATE 1e-3", 1e3, ".2f"),
    ("ratio", "× ideal", 1.0, ".2f"),
    ("rotation", "rel. rot. °", 1.0, ".4f"),
    ("rotation_claims", "error/σ rot.", 1.0, ".2f"),
    ("position_claims", "error/σ pos.", 1.0, ".2f"),
    ("induced_px", "induced px", 1.0, ".3f"),
    ("cpu_s", "CPU s", 1.0, ".0f"),
)


def scene_of(name: str, seed: int) -> tuple[Scene, Trajectory]:
    """Scene and its walk."""
    if name == "gallery":
        return build_gallery(seed), walk_poses("rectangle", "forward", FRAMES, seed)
    return build_gallery(seed + 100), walk_poses("open", "forward", FRAMES, seed)


def name_of(scene: str, seed: int, effects: frozenset[str]) -> str:
    """Name of a film, which tells an invented gait from the motion of real hands."""
    name = ("+".join(sorted(effects)) if effects != ALL else "all") or "ideal"
    return f"{scene}-{seed}-{name}{'' if HAND_MOTION.exists() else '-invented'}"


def film_of(scene: str, seed: int, effects: frozenset[str], out: Path, raw: bool = False) -> Path:
    """Folder of a film, or of its raw fisheyes, made unless it is there."""
    folder = out / "films" / (name_of(scene, seed, effects) + "-raw" * raw)
    if (folder / "slam.tum").exists():
        return folder
    print(f"filming {folder.name}", file=sys.stderr, flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    built, walk = scene_of(scene, seed)
    if raw:
        effects = effects - {"stabilised", "flow"} | {"lenses"}
    camera = (RawCamera if raw else Camera)(built, Hands(walk, seed), effects, WIDTH, seed)
    write_film(camera, folder)
    write_tum(folder / "slam.tum", degrade(camera.truth(), seed))
    return folder


def refined(film: Path, start: str, home: Path, sets: list[str]) -> dict[str, Any]:
    """Row of a run of gsba, or of the peer."""
    truth = read_trajectory(film / "groundtruth.tum")
    run = home / "run"
    frames = film / "images"
    files = sorted(path for path in frames.rglob("*") if path.is_file())
    key = {"film": digest(files), "sets": sets}
    if start == "peer":
        key |= {"peer": "spherical-incremental"}
        script = Path(__file__).with_name("peer.py")
        command = [sys.executable, str(script), "spherical-incremental", str(frames), str(run)]
        finish = partial(_outcome_of_peer, run, truth)
    else:
        key |= {"code": code_digest()}
        slam = start not in {"none", "raw-none"}
        options = [str(film / "slam.tum")] if slam else ["--no-trajectory"]
        options += ["--calibration", str(film / "calibration.json")] * (start in RAW_STARTS)
        options += [word for one in sets for word in ("--set", one)]
        command = refine_command(frames, run, options)
        finish = partial(_outcome, run, film, truth)
    row = kept_row(home, key, TIMEOUT_S)
    return row or run_row(command, home, {"key": key, "start": start}, finish, TIMEOUT_S)


def _outcome(run: Path, film: Path, truth: Trajectory) -> dict[str, Any]:
    estimate = read_trajectory(run / "trajectory.tum")
    errors = evaluate(estimate, truth)
    reconstruction, frames = load_run(run)
    claims = consistency_of(reconstruction, frames.timestamps, truth).absolute
    maps = depth_maps(film / "depth", len(truth.timestamps))
    induced = induced_errors(estimate, truth, maps, WIDTH, steps=(1,))
    row = {
        "ate": errors.ate.rmse,
        "rpe": errors.rpe_translation.rmse,
        "rotation": errors.rpe_rotation_deg.rmse,
        "rotation_claims": claims.rotation.value,
        "position_claims": claims.position.value,
        "posed": len(estimate.timestamps),
        "induced_px": induced.median_px,
    }
    return {"errors": row}


def _outcome_of_peer(out: Path, truth: Trajectory) -> dict[str, Any]:
    """Errors of a peer's poses, whose times are the numbers of frames."""
    found = read_trajectory(out / "trajectory.tum")
    rows = np.rint(found.timestamps).astype(int)
    timed = Trajectory(truth.timestamps[rows], found.world_T_rigs)
    errors = evaluate(timed, truth)
    row = {"ate": errors.ate.rmse, "rpe": errors.rpe_translation.rmse}
    return {"errors": row | {"rotation": errors.rpe_rotation_deg.rmse, "posed": len(rows)}}


def asked(words: list[str]) -> dict[str, frozenset[str]]:
    """Names and sets of effects."""
    found: dict[str, frozenset[str]] = {}
    for word in words:
        if word == "each":
            found |= {name: frozenset([name]) for name in EFFECTS}
        else:
            some, *less = word.split("-")
            named = frozenset(some.split("+")) - {"ideal"}
            named = ALL | named - {"all"} if "all" in named else named
            if unknown := (named | set(less)) - set(EFFECTS):
                raise SystemExit(f"--effects: {', '.join(unknown)} is none of {', '.join(EFFECTS)}")
            found[word] = named - set(less)
    return found


def cells(rows: list[dict[str, Any]], ideal: float | None) -> list[str]:
    """Geometric means of the rows that ended (frames: the fewest), or why they failed."""
    ended = [row["errors"] | {"cpu_s": row["cpu_s"]} for row in rows if "errors" in row]
    if not ended:
        return [str(rows[0].get("reason", "failed")), *[""] * (len(COLUMNS) - 1)]
    found = {}
    for key in ended[0]:
        values = [float(row[key]) for row in ended]
        mean = float(np.exp(np.mean(np.log(np.maximum(values, 1e-9)))))
        found[key] = min(values) if key == "posed" else mean
    if ideal:
        found["ratio"] = found["ate"] / ideal
    lost = f" ({len(rows) - len(ended)} failed)" if len(ended) < len(rows) else ""
    texts = [format(x * found[key], form) if key in found else "" for key, _, x, form in COLUMNS]
    return [texts[0] + lost, *texts[1:]]


def main() -> None:
    """Film, refine, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["gallery"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument(
        "--effects",
        nargs="+",
        default=["ideal", "each", "all"],
        help=f"ideal, each, all, a+b, all-a; only all+a has these: {', '.join(NOT_IN_ALL)}",
    )
    parser.add_argument("--starts", nargs="+", choices=[*STARTS, *RAW_STARTS], default=list(STARTS))
    parser.add_argument("--peer", action="store_true")
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    out = options.out.resolve()
    head = ["scene", "effect", "from", *(title for _, title, *_ in COLUMNS)]
    lines = [f"| {' | '.join(head)} |", "|---|---|---|" + "---:|" * len(COLUMNS)]
    print("\n".join(lines), flush=True)
    for scene in options.scenes:
        ideals: dict[str, float] = {}
        for name, effects in asked(options.effects).items():
            for start in [*options.starts, *(["peer"] if options.peer else [])]:
                rows = []
                for seed in options.seeds:
                    film = film_of(scene, seed, effects, out, start in RAW_STARTS)
                    home = out / "rows" / "-".join([film.name, start, *options.sets])
                    rows.append(refined(film, start, home, options.sets))
                done = [row["errors"]["ate"] for row in rows if "errors" in row]
                if not effects and done:
                    ideals[start] = float(np.exp(np.mean(np.log(done))))
                found = cells(rows, ideals.get(start))
                lines.append(f"| {scene} | {name} | {start} | {' | '.join(found)} |")
                print(lines[-1], flush=True)
    hands = "real hands" if HAND_MOTION.exists() else "an invented gait: no recording of hands here"
    effects = [f"- `{name}`: {text}" for name, text in EFFECTS.items()]
    foot = ["", f"{FRAMES} frames of {WIDTH} px, motion of {hands}.", "", *effects]
    write_table([*lines, *foot], options.markdown)


if __name__ == "__main__":
    main()
