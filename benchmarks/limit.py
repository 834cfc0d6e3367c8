"""Errors of runs beside the Cramer-Rao limit of the pixels that they used.

    python benchmarks/limit.py RUN TRUTH.tum CLEAN
    python benchmarks/limit.py --films WORK [--scenes gallery] [--effects ideal] [--markdown FILE]
    python benchmarks/limit.py --films WORK --patches

CLEAN holds the run's frames as they were before noise, by the same names: what differs is noise.
With `--films`, runs are those that `filmed.py --out WORK` kept, and clean frames are filmed anew,
without the effects of `NOISY`, by `--rays` across a pixel: films have one, which aliases.

No unbiased estimator errs less. The information is that of the pixels of a patch around each
observation, each pixel counted once: gradients of the clean frame, whitened by the spectrum of the
noise and by how strong it is around. Points, brightness and contrast of patches are unknown. Slopes
of patches, calibration and motion within a frame count as known, and noise as independent of the
picture, which a codec's is not: the true limit is higher.

`--patches` aligns the runs' patches under true poses and on true surfaces, and compares errors with
claims by how differently the pixels of two frames cover a surface.
"""

import argparse
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from common import write_table
from filmed import SCENES, STARTS, WIDTH, asked, film_of, name_of, scene_of
from filmed_camera import Camera, Hands
from scipy import sparse
from scipy.spatial import KDTree

from factors import tangent_basis
from factors.patches import ALIGNED, expect, found_at
from gsba.camera.sphere import bearings_from_erp
from gsba.demo.raycast import Scene, ranges
from gsba.disk import write_image
from gsba.evaluate.trajectory import evaluate
from gsba.frames.panorama import Greys
from gsba.photometric.alignment import coverage_differences, slopes_of
from gsba.photometric.frame_jobs import align, cut
from gsba.photometric.references import references
from gsba.store.finished import load_run
from gsba.store.shards import Threads
from gsba.trajectory.files import read_trajectory
from gsba.types import Counts, FrameSet, Landmarks, Reconstruction, Tracks, Trajectory

NOISY = frozenset({"noise", "mosaic", "denoise", "hevc", "hevc10"})
PATCH = 21  # pixels across an aligned patch on a surface whose slope is known
_LAG = 8  # pixels, largest of the noise's correlation
_AROUND = 8.0  # pixels, standard deviation of the window in which the noise's strength is measured
_ROUNDING = 0.3  # grey values, least noise of 8 bits
_LEAST_POWER = 0.02  # of the noise at any frequency, over white noise of the same strength
_DERIVATIVE = np.array([[1, -8, 0, 8, -1]]) / 12
_DRAWS = 2000
_HEAD = (
    "| film | from | frames | ATE 1e-3 | limit (90 % of runs) | ATE / limit | rel. rot. ° | limit "
    "| / limit | patch px, claimed | limit |"
)
_PATCH_HEAD = "| film | pixels cover | patches | error | claimed | error / claimed |"


class Limit(NamedTuple):
    """Errors of an efficient estimator, root mean squares."""

    ate: float  # units of the truth
    ates: np.ndarray  # (2,), between which are 90 % of single runs
    rotation_deg: float  # of consecutive poses
    patch_px: float  # an observation's error in the median, pixels


def grey_of(path: Path) -> np.ndarray:
    """Grey values (H, W) float32, 0..255, of a picture of 8 or 16 bits."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if picture is None:
        raise SystemExit(f"{path} cannot be read")
    scale = np.float32(257 if picture.dtype == np.uint16 else 1)
    return cv2.cvtColor(picture.astype(np.float32) / scale, cv2.COLOR_BGR2GRAY)


def frames_and_noise(frames: FrameSet, clean: Path) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Clean frames (H, W) in the filmed brightness, and their noise (H, W)."""
    for path in (Path(one) for one, *_ in frames.paths):
        filmed, pure = grey_of(path), grey_of(clean / f"{path.stem}.png")
        gain, offset = np.polyfit(pure.ravel(), filmed.ravel(), 1)
        yield gain * pure + offset, filmed - (gain * pure + offset)


def strength(noise: np.ndarray) -> np.ndarray:
    """Standard deviation (H, W) of the noise around each pixel."""
    return np.sqrt(cv2.GaussianBlur(noise**2, (0, 0), _AROUND) + _ROUNDING**2)


def spectrum(pairs: Iterator[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Power (H, W) of the noise over its strength, by frequency: transform of its correlations
    between 60 degrees north and south (Blackman and Tukey)."""
    total, shape = np.zeros((2 * _LAG + 1, 2 * _LAG + 1)), (0, 0)
    lags = np.arange(-_LAG, _LAG + 1)
    for _, noise in pairs:
        shape, rows = noise.shape, slice(len(noise) // 6, 5 * len(noise) // 6)
        scaled = noise / strength(noise)
        for i, j in np.ndindex(total.shape):
            total[i, j] += np.mean(scaled[rows] * np.roll(scaled, (lags[i], lags[j]), (0, 1))[rows])
    taper = np.hanning(2 * _LAG + 3)[1:-1]
    correlations = np.zeros(shape)
    correlations[lags[:, None], lags] = total / total[_LAG, _LAG] * np.outer(taper, taper)
    return np.maximum(np.fft.fft2(correlations).real, _LEAST_POWER)


def informations(
    clean: np.ndarray, noise: np.ndarray, power: np.ndarray, bearings: np.ndarray, patch: int
) -> np.ndarray:
    """Information (N, 2, 2), 1 / pixels squared, on where a frame shows patches at bearings (N, 3),
    columns and rows of the panorama; patches are discs of the area of `patch` squared."""
    height, width = clean.shape
    signals = [
        cv2.filter2D(clean, cv2.CV_64F, _DERIVATIVE),
        cv2.filter2D(clean, cv2.CV_64F, _DERIVATIVE.T),
        clean,
        np.ones_like(clean),
    ]
    local = strength(noise)
    white = [np.fft.ifft2(np.fft.fft2(one / local) / np.sqrt(power)).real for one in signals]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = bearings_from_erp(np.stack([u, v], axis=-1), width, height).reshape(-1, 3)
    radius = patch / np.sqrt(np.pi) * 2 * np.pi / width
    nearest = KDTree(bearings).query(rays, distance_upper_bound=radius, workers=-1)
    owners = np.asarray(nearest[1])
    inside = owners < len(bearings)
    values = np.stack([one.ravel()[inside] for one in white])
    gram = np.zeros((len(bearings), 4, 4))
    for i, j in np.ndindex(4, 4):
        products = values[i] * values[j]
        gram[:, i, j] = np.bincount(owners[inside], products, minlength=len(bearings))
    nuisance = gram[:, 2:, 2:] + 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    known = np.linalg.solve(nuisance + 1e-12 * np.eye(2), gram[:, 2:, :2])
    return gram[:, :2, :2] - np.einsum("nki,nkj->nij", gram[:, 2:, :2], known)


def pose_covariance(
    result: Reconstruction, information: np.ndarray, width: int, height: int
) -> np.ndarray:
    """Covariance (6 F, 6 F) of poses [rotation in the rig, position in the world] without a gauge
    (pseudo-inverse), points eliminated; information: (O, 2, 2) of the observations."""
    points, frames = result.observation_points, result.observation_frames
    num, count = len(points), len(result.world_T_rigs)
    R, c = result.world_T_rigs[frames, :3, :3], result.world_T_rigs[frames, :3, 3]
    y = np.einsum("oji,oj->oi", R, result.points_world[points] - c)
    ray = y - (0 if result.observation_origins is None else result.observation_origins)
    across, square = np.hypot(ray[:, 0], ray[:, 2]), (ray**2).sum(axis=1)
    of_ray = np.zeros((num, 2, 3))  # of columns and rows
    of_ray[:, 0, 0], of_ray[:, 0, 2] = ray[:, 2] / across**2, -ray[:, 0] / across**2
    of_ray[:, 1] = -(ray[:, 1] / across / square)[:, None] * ray
    of_ray[:, 1, 1] += 1 / across
    of_ray *= np.array([width / (2 * np.pi), height / np.pi])[:, None]
    turning = np.cross(np.eye(3)[None], y[:, None]).transpose(0, 2, 1)  # y x . , by the columns
    values, vectors = np.linalg.eigh(information)
    root = np.sqrt(np.maximum(values, 0))[:, :, None] * vectors.transpose(0, 2, 1)
    of_point = root @ of_ray @ R.transpose(0, 2, 1)
    of_pose = np.concatenate([-root @ of_ray @ turning, -of_point], axis=2)
    starts = np.arange(num + 1)
    A = sparse.bsr_matrix((of_pose, frames, starts), shape=(2 * num, 6 * count)).tocsr()
    B = sparse.bsr_matrix((of_point, points, starts), shape=(2 * num, 3 * len(result.points_world)))
    B = B.tocsr()
    V = np.zeros((len(result.points_world), 3, 3))
    np.add.at(V, points, np.einsum("oki,okj->oij", of_point, of_point))
    V += (1e-9 * np.trace(V, axis1=1, axis2=2) + 1e-12)[:, None, None] * np.eye(3)
    rows = np.arange(len(V))
    inverse = sparse.bsr_matrix((np.linalg.inv(V), rows, np.arange(len(V) + 1)))
    W = (A.T @ B).tocsr()
    reduced = (A.T @ A - W @ inverse @ W.T).toarray()
    scale = 1 / np.sqrt(np.diag(reduced))  # radians and units, made alike
    values, vectors = np.linalg.eigh(scale[:, None] * reduced * scale)
    kept = vectors[:, 7:] * scale[:, None]  # all but a similarity
    return np.einsum("ik,k,jk->ij", kept, 1 / values[7:], kept)


def limit_of(result: Reconstruction, frames: FrameSet, clean: Path, patch: int) -> Limit:
    """Limit of a map from its frames as filmed and clean, in its own units."""
    power = spectrum(frames_and_noise(frames, clean))
    information = np.zeros((len(result.observation_points), 2, 2))
    for f, (pure, noise) in enumerate(frames_and_noise(frames, clean)):
        rows = np.flatnonzero(result.observation_frames == f)
        bearings = result.observation_bearings[rows]
        information[rows] = informations(pure, noise, power, bearings, patch)
    height, width = power.shape
    covariance = pose_covariance(result, information, width, height)
    num, positions = len(result.world_T_rigs), result.world_T_rigs[:, :3, 3]
    shift = np.arange(6 * num).reshape(num, 6)[:, 3:].ravel()
    gauge = np.concatenate(  # translation, rotation, scale of all positions
        [
            np.tile(np.eye(3), (num, 1, 1)),
            np.cross(np.eye(3)[None], positions[:, None]).transpose(0, 2, 1),
            positions[:, :, None],
        ],
        axis=2,
    ).reshape(3 * num, 7)
    aligned = np.eye(3 * num) - gauge @ np.linalg.pinv(gauge)
    moved = aligned @ covariance[np.ix_(shift, shift)] @ aligned.T
    values, vectors = np.linalg.eigh(moved)
    draws = np.random.default_rng(0).standard_normal((_DRAWS, len(values)))
    drawn = (draws * np.sqrt(np.maximum(values, 0))) @ vectors.T
    ates = np.sqrt((drawn**2).sum(axis=1) / num)
    R = result.world_T_rigs[:, :3, :3]
    turns = np.zeros((num - 1, 3, 6 * num))
    for f in range(num - 1):
        turns[f, :, 6 * f + 6 : 6 * f + 9] = np.eye(3)
        turns[f, :, 6 * f : 6 * f + 3] = -R[f + 1].T @ R[f]
    squares = np.einsum("fai,ij,faj->f", turns, covariance, turns, optimize=True)
    determined = information[np.linalg.det(information) > 0]
    errors = np.sqrt(np.trace(np.linalg.inv(determined), axis1=1, axis2=2) / 2)
    return Limit(
        float(np.sqrt(np.trace(moved) / num)),
        np.quantile(ates, [0.05, 0.95]),
        float(np.degrees(np.sqrt(squares.mean()))),
        float(np.median(errors)),
    )


def row_of(name: str, start: str, run: Path, truth: Trajectory, clean: Path, patch: int) -> str:
    """Row of the table."""
    result, frames = load_run(run)
    errors = evaluate(Trajectory(frames.timestamps, result.world_T_rigs), truth)
    limit = limit_of(result, frames, clean, patch)
    width = grey_of(Path(frames.paths[0][0])).shape[1]
    claimed = float(np.median(result.observation_sigmas)) * width / (2 * np.pi)
    ate, low, high = (1e3 * errors.scale * one for one in (limit.ate, *limit.ates))
    turn = errors.rpe_rotation_deg.rmse
    cells = [
        name,
        start,
        str(len(frames.names)),
        f"{1e3 * errors.ate.rmse:.2f}",
        f"{ate:.2f} ({low:.2f} to {high:.2f})",
        f"{1e3 * errors.ate.rmse / ate:.2f}",
        f"{turn:.4f}",
        f"{limit.rotation_deg:.4f}",
        f"{turn / limit.rotation_deg:.2f}",
        f"{claimed:.3f}",
        f"{limit.patch_px:.3f}",
    ]
    return f"| {' | '.join(cells)} |"


def _surfaces(
    scene: Scene, world_T_rigs: np.ndarray, hosts: np.ndarray, bearings: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (J,) of the scene along bearings (J, 3) of frames (J,), normals (J, 3) of any
    length, rig frames, and (J,) bool, True where it is a plane as far as `reach`, radians."""
    axes = np.swapaxes(tangent_basis(bearings), 1, 2)
    inverse = np.zeros((5, len(hosts)))
    steps = reach * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for f in np.unique(hosts):
        rows = np.flatnonzero(hosts == f)
        for k, step in enumerate(steps):
            rays = bearings[rows] + axes[rows] @ step
            lengths = np.linalg.norm(rays, axis=1)
            directions = rays / lengths[:, None] @ world_T_rigs[f, :3, :3].T
            seen = ranges(scene, world_T_rigs[f, :3, 3], directions)
            inverse[k, rows] = lengths / np.where(seen > 0, seen, np.inf)
    slopes = np.stack([inverse[1] - inverse[2], inverse[3] - inverse[4]], axis=1) / (2 * reach)
    bent = np.abs([inverse[1] + inverse[2], inverse[3] + inverse[4]] - 2 * inverse[0]).max(axis=0)
    plane = (inverse[0] > 0) & (bent <= 1e-5 * inverse[0])
    normals = inverse[0][:, None] * bearings + np.einsum("jic,jc->ji", axes, slopes)
    return 1 / np.maximum(inverse[0], 1e-300), normals, plane


def patch_rows(run: Path, film: Path, scene: Scene, patch: int) -> list[str]:
    """Rows of the table of single alignments, errors in template pixels along one axis."""
    result, frames = load_run(run)
    truth = read_trajectory(film / "groundtruth.tum").world_T_rigs
    points, seeing = result.observation_points, result.observation_frames.astype(np.int64)
    central = central_observations(result)
    hosts, origins = seeing[central], result.observation_bearings[central]
    pixel, step = 2 * np.pi / WIDTH, 1.4
    distances, normals, plane = _surfaces(scene, truth, hosts, origins, patch / 2 * pixel)
    spreads = step * pixel * np.swapaxes(tangent_basis(origins), 1, 2)
    tilted = spreads + origins[:, :, None] * slopes_of(normals, origins, spreads)[:, None, :]
    away = truth[hosts, :3, :3] * distances[:, None, None]
    used = np.flatnonzero(plane[points] & (seeing != hosts[points]))
    of, at = points[used], seeing[used]
    to_rig = np.swapaxes(truth[at, :3, :3], 1, 2)
    centres = truth[hosts, :3, 3] + np.einsum("jab,jb->ja", away, origins)
    rays = np.einsum("oab,ob->oa", to_rig, centres[of] - truth[at, :3, 3])
    ranged = np.linalg.norm(rays, axis=1)
    predicted = rays / ranged[:, None]
    across = to_rig @ (away @ tilted)[of] / ranged[:, None, None]
    greys, threads, sightings = Greys(frames, WIDTH), Threads(2), expect(of, predicted, across)
    patches = cut("templates", greys, hosts, origins, tilted, 15, threads)
    align("align", greys, at, patches, sightings, threads)
    seen = np.zeros(len(used), bool)
    for f in range(len(frames)):
        rows = np.flatnonzero(at == f)
        there = ranges(scene, truth[f, :3, 3], predicted[rows] @ truth[f, :3, :3].T)
        seen[rows] = np.abs(there - ranged[rows]) < 1e-3 * ranged[rows]
    bases = tangent_basis(predicted)
    axes = bases @ across
    unlike = coverage_differences(axes, pixel, np.full(len(used), step))
    errors = np.linalg.solve(axes, bases @ found_at(sightings)[0][:, :, None])[..., 0]
    claims = patches.shift_covariances(sightings.templates, sightings.variances)
    squares = np.einsum("oi,oij,oj->o", errors, np.linalg.pinv(claims), errors)
    kept = seen & (sightings.states == ALIGNED) & (sightings.scores > 0.75)
    median = np.sqrt(2 * np.log(2))  # of the length of a normal vector of two dimensions
    rows = []
    for low, high in pairwise((0, 0.3, 0.8, 1.5, 2.5, 4, 6, 12)):
        some = np.flatnonzero(kept & (unlike >= low) & (unlike < high))
        error = np.median(np.linalg.norm(errors[some], axis=1)) / median
        claim = np.median(np.sqrt(np.trace(claims[some], axis1=1, axis2=2) / 2))
        ratio = np.median(np.sqrt(squares[some])) / median
        cells = [f"{low:g} to {high:g}", f"{len(some)}", f"{error:.4f}", f"{claim:.4f}"]
        rows.append(f"| {' | '.join([*cells, f'{ratio:.2f}'])} |")
    return rows


def central_observations(result: Reconstruction) -> np.ndarray:
    """Row (J,) of each point's most central observation, which its patch is cut from."""
    points, frames = result.observation_points, result.observation_frames
    tracks = Tracks(points, frames, np.zeros(len(points), np.int32), len(result.points_world))
    counts = Counts(len(points), len(points), "observations", {})
    return references(Landmarks(result.points_world, tracks, counts), result.world_T_rigs)


def clean_film(scene: str, seed: int, effects: frozenset[str], rays: int, out: Path) -> Path:
    """Folder of a film's frames without noise, made unless it is there."""
    kept = effects - NOISY
    folder = out / "clean" / f"{name_of(scene, seed, kept)}-{rays}"
    built, walk = scene_of(scene, seed)
    if (folder / f"{len(walk.timestamps) - 1:06d}.png").exists():
        return folder
    print(f"filming {folder.name} without noise", file=sys.stderr, flush=True)
    folder.mkdir(parents=True, exist_ok=True)
    camera = Camera(built, Hands(walk, seed), kept, WIDTH, seed, grain=0, rays=rays)
    for f, burst in enumerate(camera.frames()):
        write_image(folder / f"{f:06d}.png", (257 * burst[-1] + 0.5).astype(np.uint16))
    return folder


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", nargs="*", metavar="RUN TRUTH CLEAN", type=Path)
    parser.add_argument("--films", type=Path, metavar="WORK")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["gallery"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--effects", nargs="+", default=["ideal"])
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=list(STARTS))
    parser.add_argument("--patches", action="store_true")
    parser.add_argument("--patch", type=int, default=PATCH)
    parser.add_argument("--rays", type=int, default=4)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    head = _PATCH_HEAD if options.patches else _HEAD
    lines = [head, "|---|---|" + "---:|" * (head.count("|") - 3)]
    print("\n".join(lines), flush=True)
    if options.run:
        if len(options.run) != 3:
            parser.error("RUN, TRUTH and CLEAN are needed")
        run, truth, clean = options.run
        lines.append(row_of(run.name, "", run, read_trajectory(truth), clean, options.patch))
        print(lines[-1], flush=True)
    if options.films:
        out = options.films.resolve()
        for scene in options.scenes:
            for name, effects in asked(options.effects).items():
                for seed in options.seeds:
                    film = film_of(scene, seed, effects, out)
                    runs = {
                        start: out / "rows" / f"{film.name}-{start}" / "run"
                        for start in options.starts
                    }
                    if options.patches:
                        built, run = scene_of(scene, seed)[0], runs[options.starts[-1]]
                        rows = patch_rows(run, film, built, PATCH)
                        rows = [f"| {scene} {name} {row}" for row in rows]
                    else:
                        clean = clean_film(scene, seed, effects, options.rays, out)
                        truth = read_trajectory(film / "groundtruth.tum")
                        rows = [
                            row_of(f"{scene} {name}", start, run, truth, clean, options.patch)
                            for start, run in runs.items()
                        ]
                    lines += rows
                    print("\n".join(rows), flush=True)
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
