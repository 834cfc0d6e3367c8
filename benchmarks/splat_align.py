"""Alignment of perturbed poses to a splat, alone and together with bearings.

    python benchmarks/splat_align.py RUN SPLAT --truth TRUTH.tum

Every pose of the finished RUN is perturbed independently, then aligned to the SPLAT that was
trained on the run's refined poses, which does not change. Errors are against the truth. The exit
code is 1 if the error of the joint result exceeds twice that of an alignment from the unperturbed
poses.
"""

import argparse
import sys
import time
from pathlib import Path

import gtsam
import numpy as np

from gsba.config import SplatSettings
from gsba.evaluate.trajectory import evaluate, format_table
from gsba.log import show_log
from gsba.splat import read_ply
from gsba.splat.alignment import align_to_splat
from gsba.splat.backend import choose_backend
from gsba.splat.scene import near_of
from gsba.store.finished import load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import Trajectory

MAX_FACTOR = 2.0  # of the error from unperturbed poses


def perturbed(world_T_rigs: np.ndarray, degrees: float, distance: float, seed: int) -> np.ndarray:
    """Poses (F, 4, 4) moved at random, with the given RMS angle and distance."""
    rng = np.random.default_rng(seed)
    scale = np.repeat([np.deg2rad(degrees), distance], 3) / np.sqrt(3)
    steps = scale * rng.standard_normal((len(world_T_rigs), 6))
    moved = (
        gtsam.Pose3(p).retract(step).matrix() for p, step in zip(world_T_rigs, steps, strict=True)
    )
    return np.stack(list(moved))


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("splat", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--degrees", type=float, default=0.3)
    parser.add_argument(
        "--path-share", type=float, default=0.01, help="RMS distance, part of the path's length"
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[24, 48, 96, 192])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    show_log()
    reconstruction, frames = load_run(options.run)
    gaussians, truth = read_ply(options.splat), read_trajectory(options.truth)
    poses = reconstruction.world_T_rigs
    near, backend = near_of(poses, SplatSettings()), choose_backend("cpu")
    path = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    moved = perturbed(poses, options.degrees, options.path_share * path, options.seed)
    rows, started = {}, time.process_time()
    for name, start, joined in (
        ("refined", poses, None),
        ("perturbed", moved, None),
        ("perturbed, splat", moved, False),
        ("perturbed, bearing+splat", moved, True),
        ("refined, bearing+splat", poses, True),
    ):
        found = start
        if joined is not None:
            run = reconstruction if joined else None
            found = align_to_splat(gaussians, frames, start, near, backend, options.sizes, run)
        rows[name] = evaluate(Trajectory(frames.timestamps, found), truth)
    print(format_table(rows))
    print(f"{time.process_time() - started:.0f} CPU s; path {path:.2f} map units")
    factor = rows["perturbed, bearing+splat"].ate.rmse / rows["refined, bearing+splat"].ate.rmse
    holds = factor <= MAX_FACTOR
    print(
        f"{'ok  ' if holds else 'MISS'} {factor:.2f}x the unperturbed error, at most {MAX_FACTOR}"
    )
    sys.exit(0 if holds else 1)


if __name__ == "__main__":
    main()
