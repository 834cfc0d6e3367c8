"""Registration of demo runs with scans: its accuracy, and refusals of wrong scans.

    python -m benchmarks.scans --out WORK [--seeds 40 41 ...] [--markdown FILE]

The gallery is scanned from six stations: with 5 mm noise along rays, a third missing in balls of
one to two metres, all furniture a metre from its place in the run, in a world of unknown pose and
scale, without colours. Further scans are of other buildings. Limits: 0.1 % of scale, 5 mm of
position, and no wrong building accepted. Needs open3d; runs that WORK lacks are refined.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common import write_table
from gsba import pipeline
from gsba.config import RefineSettings
from gsba.demo import gallery, make_walk
from gsba.demo.mesh import MeshBuilder
from gsba.demo.raycast import Scene, ranges
from gsba.log import GsbaError
from gsba.scans import Cloud, Registration, Scan, cloud_of, normals_of, register
from gsba.scans.surfaces import on_planes
from gsba.similarity import Sim3, pose_similarity
from gsba.store.finished import load_run
from gsba.trajectory import read_trajectory

WALKS = (("rectangle", 0), ("oval", 1), ("open", 2))  # and the seeds of their wobble
STATIONS = np.array(
    [
        [x, -1.5, z]
        for x, z in ((-4.4, -2.6), (4.4, -2.6), (4.4, 2.6), (-4.4, 2.6), (0, -2.6), (0, 2.8))
    ]
)
RAYS, NOISE, MISSING = 450_000, 0.005, 1 / 3
STEPS = {(0, 0): (-0.6, -0.8), (0, 1): (-0.9, 0.5), (1, 0): (0.8, -0.7), (1, 1): (0.6, 0.9)}
SCALE_LIMIT, PLACE_LIMIT = 0.1, 5.0  # %, mm


class Moving(MeshBuilder):
    """Mesh builder that moves faces by a metre, in a direction by their quarter of the gallery."""

    moving = False

    def face(
        self,
        corner: np.ndarray,
        edge_a: np.ndarray,
        edge_b: np.ndarray,
        texture: int,
        emission: float = 0.0,
        triangle: bool = False,
    ) -> None:
        if self.moving:
            middle = np.asarray(corner) + (np.asarray(edge_a) + edge_b) / 2
            x, z = STEPS[int(middle[0] > 0), int(middle[2] > 0)]
            corner = np.add(corner, [x, 0, z])
        super().face(corner, edge_a, edge_b, texture, emission, triangle)


def building(seed: int = 0, pictures: bool = True, **sizes: float) -> Scene:
    """Gallery with its furniture moved; other sizes or another seed give another building."""
    kept = {name: getattr(gallery, name) for name in sizes}
    for name, size in sizes.items():
        setattr(gallery, name, size)
    try:
        rng, mesh = np.random.default_rng(seed), Moving(seed)
        gallery._shell(mesh, rng)
        gallery._inner_block(mesh, rng)
        if pictures:
            gallery._hang_pictures(mesh, rng)
        mesh.moving = True
        gallery._furnish(mesh, rng)
        return mesh.build()
    finally:
        for name, size in kept.items():
            setattr(gallery, name, size)


def scanned(scene: Scene, seed: int) -> np.ndarray:
    """Points (N, 3) of a scan, in the scene's world."""
    rng, found = np.random.default_rng(seed), []
    for station in STATIONS:
        ways = rng.standard_normal((RAYS // len(STATIONS), 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        far = ranges(scene, station, ways)
        hit = far > 0
        far = far[hit] + NOISE * rng.standard_normal(hit.sum())
        found.append(station + far[:, None] * ways[hit])
    points = np.concatenate(found)
    left = np.ones(len(points), bool)
    while left.mean() > 1 - MISSING:
        hole = points[rng.choice(np.flatnonzero(left))]
        left &= np.linalg.norm(points - hole, axis=1) > rng.uniform(1, 2)
    return points[left]


class Run(NamedTuple):
    """Run of the gallery, and its true placement."""

    cloud: Cloud
    eyes: np.ndarray  # (F, 3), of the run
    true: Sim3  # into the gallery


def run_of(out: Path, walk: str, seed: int) -> Run:
    """Run of a walk, refined if it does not exist yet."""
    folder = out / f"{walk}{seed}"
    if not (folder / "run" / "gsba.json").exists():
        made = make_walk(folder / "walk", walk, "locked", 40, 1024, seed)  # type: ignore[arg-type]
        pipeline.refine(made.frames_dir, made.slam_path, folder / "run", RefineSettings())
    run, _ = load_run(folder / "run")
    truth = read_trajectory(folder / "walk" / "groundtruth.tum")
    true = pose_similarity(run.world_T_rigs, truth.world_T_rigs)
    return Run(cloud_of(run, normals_of), run.world_T_rigs[:, :3, 3], true)


def judged(run: Run, points: np.ndarray, seed: int) -> dict[str, Any]:
    """Row: accepted or refused, and its errors."""
    rng = np.random.default_rng([seed, 1])
    turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    into = Sim3(float(np.exp(rng.uniform(-1, 1))), turn, rng.normal(0, 20, 3))
    laid, normals, scatters = on_planes(into.points(points))
    try:
        found = register(run.cloud, Scan(laid, normals, scatters=scatters))
    except GsbaError as error:
        return {"outcome": f"refused: {str(error).partition(':')[0]}"}
    return {"outcome": "taken", **_errors(found, run, into)}


def _errors(found: Registration, run: Run, into: Sim3) -> dict[str, float]:
    """Errors of the scale and of camera positions, and both over the registration's sigmas."""
    fit, true = found.fit, run.true
    true = Sim3(
        into.scale * true.scale,
        into.rotation @ true.rotation,
        into.points(true.translation[None])[0],
    )
    here = fit.similarity
    off = np.linalg.norm(here.points(run.eyes) - true.points(run.eyes), axis=1) / into.scale
    shift = fit.middle - true.points(here.points_back(fit.middle[None]))[0]
    whitened = np.r_[shift, np.log(here.scale / true.scale)] / fit.sigmas[3:]
    return {
        "scale": 100 * (here.scale / true.scale - 1),
        "place": 1000 * float(off.max()),
        "sigmas": float(np.sqrt(np.mean(whitened**2))),
        "explained": 100 * found.verdict.share,
        "agreement": 100 * found.verdict.agreement,
        "doubt": found.doubt,
    }


def wrong_buildings(seed: int) -> dict[str, Callable[[], np.ndarray]]:
    """Scans of other buildings, by name."""
    return {
        "mirrored": lambda: scanned(building(), seed) * [-1, 1, 1],
        "2 % longer": lambda: scanned(building(), seed) * [1.02, 1, 1],
        "another block": lambda: scanned(building(1, BLOCK_X=1.5, BLOCK_Z=1.6), seed),
        "another size": lambda: scanned(building(2, HALF_X=6.0, HALF_Z=6.2, HEIGHT=3.2), seed),
        "shell only": lambda: scanned(building(pictures=False), seed),
    }


def _table(rows: list[dict]) -> list[str]:
    columns = {
        "scale": "scale %",
        "place": "place mm",
        "sigmas": "error / sigma",
        "explained": "explained %",
        "agreement": "agreement %",
        "doubt": "doubt",
    }
    lines = ["| run | scan | outcome | " + " | ".join(columns.values()) + " |"]
    lines.append("|---|---|---|" + "---|" * len(columns))
    for row in rows:
        cells = [f"{row[name]:.2g}" if name in row else "" for name in columns]
        lines.append("| " + " | ".join([row["run"], row["scan"], row["outcome"], *cells]) + " |")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(40, 48)))
    parser.add_argument("--markdown", type=Path)
    arguments = parser.parse_args()
    rows, good = [], True
    for n, seed in enumerate(arguments.seeds):
        walk = WALKS[n % len(WALKS)]
        row = judged(run_of(arguments.out, *walk), scanned(building(), seed), seed)
        taken = row["outcome"] == "taken"
        good &= taken and abs(row["scale"]) <= SCALE_LIMIT and row["place"] <= PLACE_LIMIT
        rows.append({"run": walk[0], "scan": f"seed {seed}", **row})
        print(rows[-1], flush=True)
    right = len(rows)
    for name, scan in wrong_buildings(arguments.seeds[0]).items():
        row = judged(run_of(arguments.out, *WALKS[0]), scan(), arguments.seeds[0])
        good &= row["outcome"] != "taken"
        rows.append({"run": WALKS[0][0], "scan": name, **row})
        print(rows[-1], flush=True)
    sigmas = [row["sigmas"] for row in rows[:right] if row["outcome"] == "taken"]
    ratio = float(np.sqrt(np.mean(np.square(sigmas)))) if sigmas else float("nan")
    summary = f"Errors over standard deviations, root mean square of all seeds: {ratio:.2f}"
    print(summary)
    write_table([*_table(rows), "", f"{summary}."], arguments.markdown)
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
