"""Bundle adjustment of synthetic 360-degree walks by our solver and by pycolmap's.

    python benchmarks/solver.py --size M --peer

Each solver runs in a separate process; CPU seconds are of its solve, peak memory is of the process.
All results are compared by one function: the robust angular cost with landmarks optimised for the
resulting poses. The table states whether the targets hold.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from common import peak_mb

SIZES = {  # frames, landmarks
    "S": (120, 23_700),
    "M": (500, 98_623),
    "L": (2_000, 375_000),
    "XL": (8_000, 1_500_000),
}
SIGMA = np.radians(0.05)  # per-axis bearing noise
LOSS_SCALE = 2.0  # Cauchy, in sigmas
OUTLIERS = 0.02
WIDTH, HEIGHT = 4096, 2048  # of the peer's equirectangular images
OURS, PEER = "ours", "pycolmap-erp"


@dataclass(frozen=True, slots=True)
class Problem:
    """Closed walk with noisy observations; initial poses and landmarks have the drift of SLAM."""

    truth_world_T_rigs: np.ndarray  # (F, 4, 4)
    world_T_rigs: np.ndarray  # (F, 4, 4) start
    points_world: np.ndarray  # (J, 3) start
    frames: np.ndarray  # (O,) int32
    points: np.ndarray  # (O,) int32, sorted
    bearings_rig: np.ndarray  # (O, 3) unit


@dataclass(frozen=True, slots=True)
class Result:
    """Result of one solver."""

    solver: str
    cpu_s: float  # of the solve
    wall_s: float
    peak_mb: float  # of the whole process
    iterations: int
    converged: bool
    cost: float = float("nan")  # by the common function


def make_problem(num_frames: int, num_points: int, seed: int = 0) -> Problem:
    """Generate a closed oval walk of 0.3 units a frame, with landmarks within 6 units around it."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(num_frames) / num_frames
    radius = 0.3 * num_frames / (2 * np.pi)
    position = radius * np.column_stack([np.cos(angle), 0.02 * np.sin(5 * angle), np.sin(angle)])
    truth = _poses(_rotations(np.column_stack([0 * angle, -angle, 0 * angle])), position)
    host = rng.integers(num_frames, size=num_points)
    offset = rng.normal(size=(num_points, 3))
    offset *= rng.uniform(1, 6, (num_points, 1)) / np.linalg.norm(offset, axis=1, keepdims=True)
    points = position[host] + offset
    length = rng.integers(3, 14, size=num_points)  # 8 observations on average
    owners = np.repeat(np.arange(num_points), length).astype(np.int32)
    place = np.arange(len(owners)) - np.repeat(np.cumsum(length) - length, length)
    frames = ((host[owners] + place - (length // 2)[owners]) % num_frames).astype(np.int32)
    local = np.einsum("nji,nj->ni", truth[frames, :3, :3], points[owners] - truth[frames, :3, 3])
    bearings = _noisy(local, SIGMA, rng)
    wild = rng.random(len(bearings)) < OUTLIERS
    bearings[wild] = _noisy(bearings[wild], np.radians(3.0), rng)
    drift = _poses(
        _rotations(np.radians(0.03) * rng.normal(size=(num_frames, 3))),
        0.006 * rng.normal(size=(num_frames, 3)),
    )
    start = truth.copy()
    for f in range(1, num_frames):
        start[f] = start[f - 1] @ np.linalg.inv(truth[f - 1]) @ truth[f] @ drift[f]
    moved = start @ np.linalg.inv(truth)  # each landmark drifts with its host frame
    points = np.einsum("nij,nj->ni", moved[host, :3, :3], points) + moved[host, :3, 3]
    points += 0.01 * np.linalg.norm(offset, axis=1, keepdims=True) * rng.normal(size=points.shape)
    return Problem(truth, start, points, frames, owners, bearings)


def solve_ours(problem: Problem, num_threads: int) -> tuple[Result, np.ndarray, np.ndarray]:
    """Solve by our optimiser; priors on the first pose and on one distance fix the gauge."""
    import gtsam
    from gtsam.symbol_shorthand import X

    from gsba.bundle.optimizer import optimize

    _warm_up(problem)
    wall, cpu = time.perf_counter(), time.process_time()
    block, values = _block(problem, problem.world_T_rigs, problem.points_world, num_threads)
    graph = gtsam.NonlinearFactorGraph()
    first, far = values.atPose3(X(0)), values.atPose3(X(len(problem.world_T_rigs) // 2))
    graph.add(gtsam.PriorFactorPose3(X(0), first, gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    distance = float(first.range(far))
    noise = gtsam.noiseModel.Isotropic.Sigma(1, 1e-3)
    graph.add(gtsam.RangeFactorPose3(X(0), X(len(problem.world_T_rigs) // 2), distance, noise))
    done = optimize(graph, values, [block])
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    poses = np.array([done.values.atPose3(key).matrix() for key in block.keys])
    steps = len(done.history) - 1
    return Result(OURS, cpu, wall, peak_mb(), steps, done.converged), poses, block.points_world


def _block(problem: Problem, world_T_rigs: np.ndarray, points: np.ndarray, num_threads: int):
    import gtsam
    from gtsam.symbol_shorthand import X

    from factors import BearingTerm, LandmarkBlock, RobustLoss

    values = gtsam.Values()
    for f, world_T_rig in enumerate(world_T_rigs):
        values.insert(X(f), gtsam.Pose3(world_T_rig))
    term = BearingTerm(problem.frames, problem.points, problem.bearings_rig, SIGMA)
    keys = [X(f) for f in range(len(world_T_rigs))]
    loss = RobustLoss("cauchy", LOSS_SCALE)
    return LandmarkBlock(keys, points, [term], loss, num_threads=num_threads), values


def solve_pycolmap(problem: Problem, num_threads: int) -> tuple[Result, np.ndarray, np.ndarray]:
    """Solve by the peer: one equirectangular camera a frame, with the same loss scale in pixels."""
    import pycolmap

    reconstruction = _reconstruction(problem)
    sigma_px = SIGMA * WIDTH / (2 * np.pi)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_principal_point=False,
        refine_extra_params=False,
        refine_sensor_from_rig=False,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALE * sigma_px
    options.ceres.solver_options.function_tolerance = 1e-6  # Ceres' default; pycolmap's is never
    options.ceres.solver_options.num_threads = num_threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    wall, cpu = time.perf_counter(), time.process_time()
    summary = pycolmap.create_default_bundle_adjuster(options, config, reconstruction).solve()
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    poses = np.tile(np.eye(4), (len(problem.world_T_rigs), 1, 1))
    for f, pose in enumerate(poses):
        rig_from_world = reconstruction.frame(f + 1).rig_from_world
        assert rig_from_world is not None
        pose[:3] = rig_from_world.inverse().matrix()
    points = np.array([reconstruction.point3D(j + 1).xyz for j in range(len(problem.points_world))])
    converged = summary.termination_type == pycolmap.BundleAdjustmentTerminationType.CONVERGENCE
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    ceres = summary.ceres_summary
    steps = ceres.num_successful_steps + ceres.num_unsuccessful_steps
    return Result(PEER, cpu, wall, peak_mb(), steps, converged), poses, points


def _reconstruction(problem: Problem):
    """Problem as a pycolmap reconstruction of equirectangular images."""
    import pycolmap

    from gsba.camera.sphere import erp_from_bearings

    out = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        camera_id=1, model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT]
    )
    out.add_camera_with_trivial_rig(camera)
    pixels = erp_from_bearings(problem.bearings_rig, WIDTH, HEIGHT)
    order = np.argsort(problem.frames, kind="stable")
    bounds = np.searchsorted(problem.frames[order], np.arange(len(problem.world_T_rigs) + 1))
    places = np.empty(len(order), dtype=np.int64)  # of each observation in its image
    places[order] = np.arange(len(order)) - bounds[problem.frames[order]]
    for f, world_T_rig in enumerate(problem.world_T_rigs):
        image = pycolmap.Image(
            name=f"{f:06d}.png",
            keypoints=pixels[order[bounds[f] : bounds[f + 1]]],
            camera_id=1,
            image_id=f + 1,
        )
        out.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_T_rig[:3]).inverse())
    bounds = np.searchsorted(problem.points, np.arange(len(problem.points_world) + 1))
    for j, xyz in enumerate(problem.points_world):
        track = pycolmap.Track()
        for o in range(bounds[j], bounds[j + 1]):
            track.add_element(int(problem.frames[o]) + 1, int(places[o]))
        out.add_point3D(xyz, track)
    return out


def common_cost(problem: Problem, world_T_rigs: np.ndarray, points: np.ndarray) -> float:
    """Robust angular cost of poses, with landmarks optimised for them."""
    block, values = _block(problem, world_T_rigs, points, os.cpu_count() or 1)
    return block.polish(values, num_steps=50)


def _rotations(vectors: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(vectors).as_matrix()


def _poses(rotations: np.ndarray, positions: np.ndarray) -> np.ndarray:
    from gsba.geometry import pose

    return pose(rotations, positions)


def _noisy(vectors: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors of `vectors` with a tangent noise of `sigma` radians per axis."""
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    noise = sigma * rng.normal(size=unit.shape)
    noise -= np.einsum("ni,ni->n", noise, unit)[:, None] * unit
    out = unit + noise
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def _warm_up(problem: Problem) -> None:
    """Load or compile the kernels on the first frames, so that measured solves do not compile."""
    import gtsam

    from gsba.bundle.optimizer import optimize

    few = problem.frames < 12
    part = replace(
        problem,
        world_T_rigs=problem.world_T_rigs[:12],
        frames=problem.frames[few],
        points=problem.points[few],
        bearings_rig=problem.bearings_rig[few],
    )
    block, values = _block(part, part.world_T_rigs, part.points_world, 1)
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
    for key in block.keys:
        graph.add(gtsam.PriorFactorPose3(key, values.atPose3(key), noise))
    optimize(graph, values, [block])


def _child(solver: str, folder: Path, num_threads: int) -> None:
    with np.load(folder / "problem.npz") as stored:
        problem = Problem(**{name: stored[name] for name in stored.files})
    if solver == OURS:
        result, poses, points = solve_ours(problem, num_threads)
    else:
        result, poses, points = solve_pycolmap(problem, num_threads)
    np.savez(folder / "result.npz", poses=poses, points=points, result=json.dumps(asdict(result)))


def run(problem: Problem, solver: str, num_threads: int) -> Result:
    """Solve in a child process and compute the cost of the result."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arrays = {field.name: getattr(problem, field.name) for field in fields(problem)}
        np.savez(folder / "problem.npz", **arrays)
        command = [sys.executable, __file__, "--child", solver, "--folder", name]
        command += ["--threads", str(num_threads)]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": str(num_threads)})
        with np.load(folder / "result.npz") as stored:
            result = Result(**json.loads(str(stored["result"])))
            return replace(result, cost=common_cost(problem, stored["poses"], stored["points"]))


def verdicts(results: dict[str, list[Result]]) -> list[tuple[str, bool]]:
    """Targets for the sizes and solvers that ran, with True if they hold."""
    out = []
    for size, rows in results.items():
        ours, peers = rows[0], rows[1:]
        out.append((f"{size}: converged", ours.converged))
        for peer in peers:
            optimum = ours.cost / min(row.cost for row in rows)
            cpu, memory = ours.cpu_s / peer.cpu_s, ours.peak_mb / peer.peak_mb
            out.append((f"{size}: cost {optimum:.5f} of the best, at most 1.001", optimum <= 1.001))
            if size != "M":
                continue
            out.append((f"M: CPU time 1/{1 / cpu:.1f} of the peer's, at most 1/6", cpu <= 1 / 6))
            out.append((f"M: memory {memory:.2f} of the peer's, at most 0.5", memory <= 0.5))
    if {"S", "L"} <= results.keys():
        per_landmark = {
            size: rows[0].cpu_s / (rows[0].iterations * SIZES[size][1])
            for size, rows in results.items()
        }
        growth = per_landmark["L"] / per_landmark["S"]
        out.append((f"S to L: time per step and landmark grows {growth:.2f}x", growth <= 1.5))
    return out


def main() -> None:
    """Parse, run, print; exit with 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", choices=SIZES, nargs="+", default=["S"])
    parser.add_argument("--peer", action="store_true", help="run pycolmap too")
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--child", choices=(OURS, PEER), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        _child(options.child, options.folder, options.threads)
        return
    results: dict[str, list[Result]] = {}
    print(f"{'':4} {'solver':18} {'CPU s':>8} {'wall s':>8} {'MB':>6} {'steps':>6} {'cost':>12}")
    for size in options.size:
        problem = make_problem(*SIZES[size])
        rows = results.setdefault(size, [])
        for solver in (OURS, PEER) if options.peer else (OURS,):
            row = run(problem, solver, options.threads)
            rows.append(row)
            print(
                f"{size:4} {row.solver:18} {row.cpu_s:8.2f} {row.wall_s:8.2f} {row.peak_mb:6.0f} "
                f"{row.iterations:6d} {row.cost:12.1f}{'' if row.converged else '  not converged'}",
                flush=True,
            )
    judged = verdicts(results)
    for text, held in judged:
        print(f"{'ok  ' if held else 'MISS'} {text}")
    if options.json:
        report = {size: [asdict(row) for row in rows] for size, rows in results.items()}
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    sys.exit(0 if all(held for _, held in judged) else 1)


if __name__ == "__main__":
    main()
