"""Basin of convergence of direct alignment: largest pose error in pixels, by starting level.

    python -m benchmarks.photometric_basin FOLDER [--width 1024] [--trials 4]

Six frames of a rendered walk with exact depth are used (rendered if FOLDER does not exist). Two are
fixed; the poses of the others are rotated and shifted so that patches have the given error in
pixels (root mean square). A frame has converged if its remaining error is below a tenth of a pixel.
"""

import argparse
from pathlib import Path

import gtsam
import numpy as np

from factors import RobustLoss
from factors.patch_windows import PatchPixels, PatchTable, patch_spans, pixel_grid, pixels_of
from factors.photometric import PhotometricBlock
from factors.sphere_image import SphereImage
from gsba.bundle.optimizer import optimize
from gsba.camera.sphere import bearings_from_erp
from gsba.config import PhotometricSettings, SolverSettings
from gsba.demo import make_walk
from gsba.frames.scan import scan
from gsba.photometric import patches
from gsba.trajectory.files import read_trajectory

NUM_FRAMES, HELD = 6, 2
ERRORS_PX = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
STRATEGIES = {"level 0": (0,), "levels 1, 0": (1, 0), "levels 2, 1, 0": (2, 1, 0)}


def exact_table(folder: Path, truth: np.ndarray, pyramids: list, settings: PhotometricSettings):
    """Patches of all frames on planes of the rendered depth, observed in all other frames."""
    hosts, bearings, planes = [], [], []
    for f, (greys, usable) in enumerate(pyramids):
        depth = np.load(folder / "depth" / f"{f:06d}.npz")["range"]
        height, width = depth.shape
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = bearings_from_erp(np.stack([u, v], axis=-1), width, height)
        hit = depth > 0
        found = patches.candidates(greys[0], usable, settings)
        laid, clear = patches.lay_planes(found, rays[hit] * depth[hit][:, None], settings)
        hosts.append(np.full(np.count_nonzero(clear), f))
        bearings.append(found[clear])
        planes.append(laid[clear])
    host, plane = np.concatenate(hosts), np.concatenate(planes)
    targets = np.array([[f for f in range(len(truth)) if f != h] for h in host])
    offsets = np.arange(len(host) + 1, dtype=np.int64) * targets.shape[1]
    grid = pixel_grid(settings.size, 2 * np.pi / pyramids[0][0][0].shape[1])
    sigmas = plane[:, :1] * [settings.depth_sigma, settings.slope_sigma, settings.slope_sigma]
    return PatchTable(host, np.concatenate(bearings), plane, sigmas, offsets, targets.ravel(), grid)


def off_by(table: PatchTable, true: np.ndarray, poses: np.ndarray, width: int) -> np.ndarray:
    """RMS errors (F,) of the patches' projections in each frame, pixels."""
    rows = np.arange(len(table.targets))
    a, b = (
        pixels_of(patch_spans(table, p, table.planes, rows)[:, 0], width) for p in (true, poses)
    )
    du = (a[:, 0] - b[:, 0] + width / 2) % width - width / 2
    du *= np.cos(np.pi * (a[:, 1] / (width / 2) - 0.5))
    squared = du**2 + (a[:, 1] - b[:, 1]) ** 2
    counts = np.bincount(table.targets, minlength=len(true))
    return np.sqrt(np.bincount(table.targets, squared, len(true)) / counts)


def disturb(table: PatchTable, true: np.ndarray, error_px: float, width: int, rng) -> np.ndarray:
    """Poses whose patches have an RMS error of `error_px`; fixed frames keep theirs."""
    out = true.copy()
    distance = 1 / np.median(table.planes[:, 0])
    for f in range(HELD, len(true)):
        step = rng.normal(size=6) * np.r_[np.ones(3), distance * np.ones(3)]
        step *= error_px * 2 * np.pi / width / 2
        for _ in range(3):  # the scale that gives the error
            out[f] = gtsam.Pose3(true[f]).retract(step).matrix()
            step *= error_px / off_by(table, true, out, width)[f]
        out[f] = gtsam.Pose3(true[f]).retract(step).matrix()
    return out


def solve(
    table: PatchTable, pyramids: list, start: np.ndarray, levels: tuple, error_px: float
) -> np.ndarray:
    """Poses after alignment on successive levels."""
    poses = start
    for level in levels:
        width = pyramids[0][0][level].shape[1]
        scaled = PatchTable(
            table.hosts, table.bearings_rig, table.planes, table.plane_sigmas, table.offsets,
            table.targets, table.grid * 2.0**level,
        )  # fmt: skip
        pixels = PatchPixels(scaled, poses, width, margin=6 + 2 * error_px)
        for f, (greys, _) in enumerate(pyramids):
            pixels.take(f, SphereImage.of(greys[level]))
        block = PhotometricBlock(
            range(len(poses)), pixels, 10.0, RobustLoss("cauchy", 1.0), num_threads=1
        )
        graph = gtsam.NonlinearFactorGraph()
        tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
        values = gtsam.Values()
        for f, pose in enumerate(poses):
            values.insert(f, gtsam.Pose3(pose))
            if f < HELD:
                graph.add(gtsam.PriorFactorPose3(f, gtsam.Pose3(pose), tight))
        solver = SolverSettings(max_iterations=30, relative_tolerance=1e-3)
        result = optimize(graph, [block], values, solver)
        poses = np.array([result.values.atPose3(f).matrix() for f in range(len(poses))])
    return poses


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=1024)
    parser.add_argument("--trials", type=int, default=4)
    options = parser.parse_args()
    if not options.folder.exists():
        make_walk(options.folder, "oval", "forward", 40, options.width, depth=True)
    frames = scan(options.folder / "images", None, None, None)
    truth = read_trajectory(options.folder / "groundtruth.tum").world_T_rigs[:NUM_FRAMES]
    settings = PhotometricSettings(spacing_deg=10, depth_reach_deg=4)
    pyramids = [patches.pyramid(frames, f, settings, 2) for f in range(NUM_FRAMES)]
    table = exact_table(options.folder, truth, pyramids, settings)
    print(f"{len(table)} patches, {len(table.targets)} observations, {frames.format.width} px wide")
    print("start px | " + " | ".join(f"{name}: converged, median px" for name in STRATEGIES))
    for error_px in ERRORS_PX:
        cells = []
        for levels in STRATEGIES.values():
            left = []
            for trial in range(options.trials):
                rng = np.random.default_rng(trial)
                start = disturb(table, truth, error_px, frames.format.width, rng)
                poses = solve(table, pyramids, start, levels, error_px)
                left.append(off_by(table, truth, poses, frames.format.width)[HELD:])
            share = np.mean(np.concatenate(left) < 0.1)
            cells.append(f"{100 * share:.0f}%, {np.median(left):.3f}")
        print(f"{error_px:g} | " + " | ".join(cells), flush=True)


if __name__ == "__main__":
    main()
