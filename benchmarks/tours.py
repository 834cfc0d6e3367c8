"""Tours: stills metres apart without a trajectory, refined with and without a search along epipolar
lines.

    python benchmarks/tours.py OUT.md TOUR [TOUR ...] [--shuffle SEED] [--peer]

TOUR: a folder with images/*.jpg, groundtruth.tum and, if a carrier is in the pictures, mask.png, as
`render_home.py OUT -n 20` writes it. Each is refined by `gsba refine` with its defaults and with
`pairs.max_tour_frames=0`. Maps are compared with the truth, each after alignment with scale, and
the steps that the search confirms with the true ones. `--shuffle` permutes the names of the files
and leaves out their times: stills in no order, numbered in the order found. `--peer` adds both
spherical modes of `pycolmap.panorama`, which compare all pairs; they take no mask, so the carrier
fades into grey.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import cpu_of_children, write_table

import gsba
from gsba.config import RefineSettings
from gsba.config_file import load_config
from gsba.evaluate.trajectory import pose_errors
from gsba.geometry import inverse
from gsba.log import GsbaError
from gsba.odometry.tour_maps import TourMatches
from gsba.odometry.tour_steps import pose_errors_deg
from gsba.store.store import load_stage
from gsba.trajectory.files import read_trajectory, write_tum
from gsba.types import FrameSet, PoseStatus, Reconstruction, Trajectory

MAX_RIGHT_DEG = 1.0, 3.0  # rotation and direction of a step that is right
MAX_RIGHT_SHARE = 0.02  # ATE of a right map, part of its extent


def shuffled(tour: Path, seed: int, out: Path) -> Path:
    """The pictures and true poses of a tour under permuted names, without times, in a folder."""
    images = sorted((tour / "images").glob("*.jpg"))
    order = np.random.default_rng(seed).permutation(len(images))
    (out / "images").mkdir(parents=True)
    for n, row in enumerate(order):
        shutil.copy(images[row], out / "images" / f"{n:06}.jpg")
    if (tour / "mask.png").is_file():
        shutil.copy(tour / "mask.png", out)
    true = read_trajectory(tour / "groundtruth.tum")
    poses = true.world_T_rigs[order]
    write_tum(out / "groundtruth.tum", Trajectory(true.timestamps, poses))
    return out


def errors_of(maps: list[Trajectory], truth: Trajectory) -> list[tuple[np.ndarray, float]]:
    """Frames of maps of three frames and more, whose times are among the true ones, largest first,
    and the maps' ATE, part of their extent."""
    found = []
    for one in maps:
        if len(one.timestamps) < 3:
            continue
        rows = np.searchsorted(truth.timestamps, one.timestamps - 1e-6)
        true = truth.world_T_rigs[rows]
        off = pose_errors(one, Trajectory(one.timestamps, true))
        extent = np.linalg.norm(np.ptp(true[:, :3, 3], axis=0))
        found.append((rows, float(np.sqrt(np.mean(off.positions**2)) / extent)))
    return sorted(found, key=lambda one: -len(one[0]))


def maps_of(out: Path, truth: Trajectory) -> list[Trajectory]:
    """Poses of each map of a run."""
    result = load_stage(out, "reconstruction", Reconstruction)
    refined = result.pose_statuses == PoseStatus.REFINED
    labels = np.zeros(len(refined), int) if result.components is None else result.components
    rows = [refined & (labels == label) for label in np.unique(labels[refined])]
    return [Trajectory(truth.timestamps[own], result.world_T_rigs[own]) for own in rows]


def steps_of(out: Path, truth: Trajectory) -> str:
    """Steps that a run's search confirms, and those of them that are off."""
    try:
        near = load_stage(out, "tour", TourMatches).near
    except GsbaError:
        return "not searched"
    poses, num, wrong = truth.world_T_rigs, 0, list[str]()
    for (f0, f1), f0_T_f1 in zip(near.matches.pairs.tolist(), near.f0_T_f1s, strict=True):
        if f1 - f0 == 1:
            off = pose_errors_deg(inverse(f0_T_f1), inverse(poses[f1]) @ poses[f0])
            num += 1
            if off[0] > MAX_RIGHT_DEG[0] or off[1] > MAX_RIGHT_DEG[1]:
                wrong.append(f"{f0} ({off[0]:.1f}/{off[1]:.1f})")
    return f"{num}; {', '.join(wrong) or 'none'}"


def row_of(tour: Path, settings: RefineSettings, seed: int | None) -> list[str]:
    """Cells of a tour and settings: frames in maps, maps, wrong ones, steps, CPU s; its stills in
    no order with a seed."""
    with tempfile.TemporaryDirectory() as folder:
        out, began = Path(folder) / "run", time.process_time()
        tour = tour if seed is None else shuffled(tour, seed, Path(folder) / "shuffled")
        mask = tour / "mask.png"
        masks = mask if mask.is_file() else "auto"
        truth = read_trajectory(tour / "groundtruth.tum")
        try:
            gsba.refine(tour / "images", None, out, settings, masks=masks)
        except GsbaError:
            return cells_of([], truth, "refused", time.process_time() - began)
        cpu = time.process_time() - began
        names = load_stage(out, "frames", FrameSet).names  # in the order that was found
        rows = [sorted(names).index(name) for name in names]
        truth = replace(truth, world_T_rigs=truth.world_T_rigs[rows])
        return cells_of(maps_of(out, truth), truth, steps_of(out, truth), cpu)


def row_of_peer(tour: Path, mode: str, seed: int | None) -> list[str]:
    """Cells of a tour by a mode of the peer, as of `row_of`."""
    with tempfile.TemporaryDirectory() as folder:
        tour = tour if seed is None else shuffled(tour, seed, Path(folder) / "shuffled")
        frames, out = Path(folder) / "frames", Path(folder) / "peer"
        frames.mkdir()
        shown = np.ones((1, 1, 1), np.float32)
        if (tour / "mask.png").is_file():
            mask = np.asarray(cv2.imread(str(tour / "mask.png"), cv2.IMREAD_GRAYSCALE))
            away = cv2.erode((mask > 0).astype(np.float32), np.ones((61, 61)))
            shown = cv2.GaussianBlur(away, (0, 0), 15)[:, :, None]
        for path in sorted((tour / "images").glob("*.jpg")):
            picture = np.asarray(cv2.imread(str(path)), np.float32)
            picture = (shown * picture + (1 - shown) * 128).astype(np.uint8)
            cv2.imwrite(str(frames / path.name), picture, [cv2.IMWRITE_JPEG_QUALITY, 98])
        truth = read_trajectory(tour / "groundtruth.tum")
        truth = Trajectory(np.arange(float(len(truth.timestamps))), truth.world_T_rigs)
        script, began = Path(__file__).with_name("peer.py"), cpu_of_children()
        command = [sys.executable, str(script), mode, str(frames), str(out)]
        subprocess.run([*command, "--matcher", "exhaustive"], capture_output=True, check=False)
        cpu, found = cpu_of_children() - began, sorted(out.glob("trajectory*.tum"))
        return cells_of([read_trajectory(path) for path in found], truth, "", cpu)


def cells_of(maps: list[Trajectory], truth: Trajectory, steps: str, cpu: float) -> list[str]:
    """Cells of a row: frames in maps, maps, wrong ones, steps, CPU s."""
    found = errors_of(maps, truth)
    said = [f"{rows[0]} to {rows[-1]} ({len(rows)}): {1e3 * ate:.1f}e-3" for rows, ate in found]
    wrong = sum(ate > MAX_RIGHT_SHARE for _, ate in found)
    total = f"{sum(len(rows) for rows, _ in found)} of {len(truth.timestamps)}"
    return [total, "; ".join(said) or "none", str(wrong), steps, f"{cpu:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("tours", type=Path, nargs="+")
    parser.add_argument("--shuffle", type=int, metavar="SEED")
    parser.add_argument("--peer", action="store_true")
    options = parser.parse_args()
    lines = [
        "| tour | search | frames in maps | maps: frames, ATE of extent | wrong maps | "
        "confirmed steps; off by more than 1° or 3° | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for tour in options.tours:
        for name, most in (("no", 0), ("yes", 100)):
            settings = load_config(None, [f"pairs.max_tour_frames={most}", "export.formats=[]"])
            cells = [tour.name, name, *row_of(tour, settings, options.shuffle)]
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
        for mode in ("spherical-incremental", "spherical-global") if options.peer else ():
            cells = [tour.name, f"peer, {mode}", *row_of_peer(tour, mode, options.shuffle)]
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    write_table(lines, options.out)


if __name__ == "__main__":
    main()
