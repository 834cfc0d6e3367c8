"""Cost of exports of 8K panoramas, beside bare decoding and encoding of the same images.

    python -m benchmarks.exports --out WORK [--frames 20] [--width 8192] [--images FOLDER]
        [--markdown FILE]

Each row is a separate process. `bare` decodes each panorama into the same memory and encodes six
images as large as its faces; `sampled` also samples them, bicubic, in one thread, which is a lower
bound for these pixels. CPU time is counted from the first frame to the last, without imports, and
for `sampled` without tables and copies for encoding.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common import measure, peak_mb, write_table
from benchmarks.memory import make_frames
from gsba.camera.rig import CubeRig
from gsba.export import ExportFormat, export_all
from gsba.export.images import face_size_for
from gsba.frames.buffers import Buffers
from gsba.frames.cubemap import cut_padded
from gsba.frames.pixels import load_padded
from gsba.frames.scan import scan
from gsba.types import FACES, FrameSet, PoseStatus, Reconstruction

ROWS = ("bare", "sampled", "colmap", "colmap,colmap-flat,nerfstudio")


def make_map(frames: FrameSet, num_points: int = 50) -> Reconstruction:
    """Straight walk among points that every frame sees."""
    num_frames, rng = len(frames), np.random.default_rng(0)
    poses = np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, 0, 3] = np.arange(num_frames)
    points = rng.normal(size=(num_points, 3)) * [30.0, 3.0, 3.0]
    of_points = np.repeat(np.arange(num_points, dtype=np.int32), num_frames)
    of_frames = np.tile(np.arange(num_frames, dtype=np.int32), num_points)
    rays = points[of_points] - poses[of_frames, :3, 3]
    return Reconstruction(
        world_T_rigs=poses,
        pose_covariances=np.full((num_frames, 6, 6), np.nan),
        pose_statuses=np.full(num_frames, PoseStatus.REFINED, np.uint8),
        points_world=points,
        point_colors=np.zeros((num_points, 3), np.uint8),
        point_errors=np.zeros(num_points),
        observation_points=of_points,
        observation_frames=of_frames,
        observation_bearings=rays / np.linalg.norm(rays, axis=1, keepdims=True),
        observation_sigmas=np.full(len(rays), 1e-3),
    )


def bare(frames: FrameSet, sampled: bool) -> float:
    """CPU seconds per frame of decoding and encoding, and of sampling if `sampled`."""
    size, buffers, spent = face_size_for(frames.format, None), Buffers(), 0.0
    rig, room = CubeRig(size, np.pi / 2), np.empty((size, size, 3), np.uint8)
    cv2.setNumThreads(1)
    for _ in cut_padded(load_padded(frames, 0, buffers), rig, room):
        pass  # tables and memory
    for f in range(len(frames)):
        start = time.process_time()
        padded = load_padded(frames, f, buffers)
        spent += time.process_time() - start
        faces = cut_padded(padded, rig, room)
        for _ in FACES:
            start = time.process_time()
            next(faces)
            spent += (time.process_time() - start) * sampled
            start = time.process_time()
            cv2.imencode(".jpg", room, [cv2.IMWRITE_JPEG_QUALITY, 95])
            spent += time.process_time() - start
    return spent / len(frames)


def run(folder: Path, row: str, out: Path) -> dict[str, float]:
    """Cost of a row, measured in this process."""
    frames = scan(folder, None, None, None)
    if row in ("bare", "sampled"):
        return {"cpu_s": bare(frames, row == "sampled"), "before_mb": 0.0, "peak_mb": peak_mb()}
    reconstruction, before = make_map(frames), peak_mb()
    outs = {ExportFormat(name): out / name for name in row.split(",")}
    start = time.process_time()
    export_all(reconstruction, frames, outs)
    spent = (time.process_time() - start) / len(frames)
    return {"cpu_s": spent, "before_mb": before, "peak_mb": peak_mb()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--width", type=int, default=8192)
    parser.add_argument("--images", type=Path, help="panoramas of your own, with their times")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    folder = options.images or options.out / "images"
    if options.row is not None:
        print(json.dumps(run(folder, options.row, options.out)))
        return
    if options.images is None:
        make_frames(folder, options.frames, options.width)
    lines = ["| | CPU s a frame | × bare | peak MB | before |", "|---|---|---|---|---|"]
    first = None
    for row in ROWS:
        log = options.out / f"{row}.log"
        command = [sys.executable, "-m", "benchmarks.exports", "--out", str(options.out)]
        command += ["--row", row, *(["--images", str(folder)] if options.images else [])]
        measure(command, log, 3600)
        found = json.loads(log.read_text().strip().splitlines()[-1])
        first = first or found["cpu_s"]
        lines.append(
            f"| {row} | {found['cpu_s']:.2f} | {found['cpu_s'] / first:.1f} "
            f"| {found['peak_mb']:.0f} | {found['before_mb']:.0f} |"
        )
        print(lines[-1], flush=True)
    write_table(lines, options.markdown)


if __name__ == "__main__":
    main()
