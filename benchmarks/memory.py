"""Peak memory of aligning patches in 8K panoramas: n frames, and twice as many.

    python benchmarks/memory.py --out WORK [--frames 24] [--width 8192] [--markdown FILE]

Frames are made by shifting one textured panorama, which is a rotating camera among points with
known positions. Only the process that aligns patches is measured.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import measure, peak_mb, write_table

from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import PatchSettings
from gsba.frames import panorama
from gsba.frames.scan import scan
from gsba.geometry import pose
from gsba.photometric import alignment
from gsba.store.shards import Threads
from gsba.types import Counts, Keypoints, Landmarks, Solution, Tracks

POINTS, DISTANCE = 60, 1e4  # points per frame, and their distance, units: without parallax


def make_frames(folder: Path, num: int, width: int) -> None:
    """Write textured JPEG panoramas, each shifted by its number of columns, and their times."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    small = rng.uniform(0, 255, (width // 8, width // 4)).astype(np.float32)
    texture = cv2.resize(small, (width, width // 2), interpolation=cv2.INTER_CUBIC)
    texture = np.clip(texture, 0, 255).astype(np.uint8)
    for f in range(num):
        path = folder / f"{f:06d}.jpg"
        if not path.exists():
            turned = np.roll(texture, 16 * f, axis=1)
            cv2.imwrite(str(path), cv2.merge([turned] * 3), [cv2.IMWRITE_JPEG_QUALITY, 90])
    rows = [f"{f:06d},{f / 10:.1f}" for f in range(num)]
    (folder / "timestamps.csv").write_text("\n".join(["name,timestamp", *rows]) + "\n")


def make_map(num: int, width: int) -> tuple[Landmarks, np.ndarray, Keypoints, CubeRig]:
    """Points with seven observations each, poses that rotate like the frames, exact keypoints."""
    angles = -2 * np.pi * 16 * np.arange(num) / width
    turns = np.array([cv2.Rodrigues(np.array([0.0, a, 0.0]))[0] for a in angles])
    poses = pose(turns, 1e-3 * np.arange(num)[:, None] * [1.0, 0.0, 0.0])
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(POINTS * num, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    middles = np.repeat(np.arange(num), POINTS)
    frames = np.clip(middles[:, None] + np.arange(-3, 4), 0, num - 1)
    keep = np.diff(frames, axis=1, prepend=-1) > 0
    points, frames = np.nonzero(keep)[0], frames[keep]
    offsets = DISTANCE * rays[points] - poses[frames, :3, 3]
    bearings = np.einsum("oji,oj->oi", poses[frames, :3, :3], offsets)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    order = np.argsort(frames, kind="stable")
    starts = np.searchsorted(frames[order], np.arange(num + 1))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    rig, faces = CubeRig(512, np.pi / 2), owner_faces(bearings[order])
    keypoints = Keypoints(
        starts, rig.project(bearings[order], faces), faces, bearings[order],
        np.full(len(order), 2e-4), np.zeros((len(order), 3), np.uint8),
    )  # fmt: skip
    tracks = Tracks(
        points.astype(np.int32), frames.astype(np.int32),
        (rank - starts[frames]).astype(np.int32), len(rays),
    )  # fmt: skip
    return Landmarks(DISTANCE * rays, tracks, Counts(0, 0, "tracks")), poses, keypoints, rig


def run(folder: Path, num_threads: int) -> dict[str, float]:
    """Align all points of the frames in a folder."""
    frames = scan(folder, None, None, None)
    landmarks, poses, keypoints, rig = make_map(len(frames), frames.format.width)
    greys = panorama.Greys(frames, PatchSettings().max_width)
    before = peak_mb()
    solved = replace(Solution.without_points(poses), landmarks=landmarks)
    observed, workers = alignment.AlignedObservations(keypoints, 15), Threads(num_threads)
    sighted = alignment.align(solved, observed, greys, rig, workers)
    kept, received = sighted.counts.kept, sighted.counts.received
    return {"frames": len(frames), "before_mb": before, "peak_mb": peak_mb(),
            "kept": kept, "received": received}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--width", type=int, default=8192)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--align", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    if options.align is not None:
        print(json.dumps(run(options.align, options.threads)))
        return
    lines = [
        f"Patches aligned in panoramas {options.width} wide, {options.threads} threads.\n",
        "| frames | peak MB | before aligning | observations | aligned | CPU s |",
        "|---|---|---|---|---|---|",
    ]
    for num in (options.frames, 2 * options.frames):
        folder = options.out / f"{num}"
        make_frames(folder, num, options.width)
        log = options.out / f"{num}.log"
        command = [sys.executable, __file__, "--out", str(options.out)]
        command += ["--threads", str(options.threads), "--align", str(folder)]
        cost = measure(command, log, 3600)
        found = json.loads(log.read_text().strip().splitlines()[-1])
        lines.append(
            f"| {num} | {cost.peak_mb:.0f} | {found['before_mb']:.0f} | {found['received']} "
            f"| {found['kept']} | {cost.cpu_s:.0f} |"
        )
        print(lines[-1], flush=True)
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
