"""Cost of the photometric block: samples linearised per CPU second, at n and at 2 n patches.

    python -m benchmarks.photometric [--patches 9000] [--targets 8] [--size 9] [--width 1536]

Frames are on a line in a sphere with a random, band-limited texture; every patch is observed in the
`targets` frames next to its host. CPU seconds are of one thread, the best of three.
"""

import argparse
import json
import time

import gtsam
import numpy as np

from benchmarks.common import machine, peak_mb
from factors import RobustLoss
from factors.patch_windows import PatchPixels, PatchTable, pixel_grid, planes_from
from factors.photometric import PhotometricBlock
from factors.sphere_image import SphereImage
from gsba.photometric.patches import halved

RADIUS = 4.0  # of the sphere, units


def make_block(num_patches: int, num_targets: int, size: int, width: int) -> tuple:
    """Block and values of 24 frames with patches at random bearings."""
    rng = np.random.default_rng(0)
    num_frames = 24
    world_T_rigs = np.tile(np.eye(4), (num_frames, 1, 1))
    world_T_rigs[:, 0, 3] = np.linspace(-1, 1, num_frames)
    hosts = np.sort(rng.integers(0, num_frames, num_patches))
    bearings = rng.normal(size=(num_patches, 3))
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    along = bearings[:, 0] * world_T_rigs[hosts, 0, 3]
    distances = -along + np.sqrt(along**2 + RADIUS**2 - world_T_rigs[hosts, 0, 3] ** 2)
    order = np.argsort(np.abs(np.arange(num_frames) - hosts[:, None]), axis=1, kind="stable")
    planes = planes_from(bearings, distances)
    table = PatchTable(
        hosts,
        bearings,
        planes,
        planes[:, :1] * [[1.0, 0.5, 0.5]],
        np.arange(num_patches + 1) * num_targets,
        order[:, 1 : num_targets + 1].ravel(),
        pixel_grid(size, 2 * np.pi / width),
    )
    pixels = PatchPixels(table, world_T_rigs, width)
    grey = halved(rng.uniform(0, 255, (width, 2 * width)).astype(np.float32))
    for frame in range(num_frames):
        pixels.take(frame, SphereImage.of(grey))
    values = gtsam.Values()
    for frame, world_T_rig in enumerate(world_T_rigs):
        values.insert(frame, gtsam.Pose3(world_T_rig))
    loss = RobustLoss("cauchy", 2.0)
    block = PhotometricBlock(range(num_frames), pixels, 5.0, loss, num_threads=1)
    block.refresh(values)
    return block, values


def measure(block: PhotometricBlock, values: gtsam.Values) -> dict[str, float]:
    """CPU seconds of the three calls of a solver step."""
    steps = np.full((len(block.keys), 6), 1e-4)
    seconds = {}
    for name, call in (
        ("linearize", lambda: block.linearize(values)),
        ("propose", lambda: block.propose(values, steps)),
        ("refresh", lambda: block.refresh(values)),
    ):
        times = []
        for _ in range(3):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
        seconds[name] = min(times)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--patches", type=int, default=9000)
    parser.add_argument("--targets", type=int, default=8)
    parser.add_argument("--size", type=int, default=9)
    parser.add_argument("--width", type=int, default=1536)
    options = parser.parse_args()
    rows = []
    for num in (options.patches, 2 * options.patches):
        block, values = make_block(num, options.targets, options.size, options.width)
        if not rows:
            measure(block, values)  # compile
        samples = num * options.targets * options.size**2
        megabytes = block._data.pixels.nbytes / 2**20
        row = {"samples": samples, "counted": int(block.counted.sum()), "windows_mb": megabytes}
        rows.append({**row, **measure(block, values), "peak_mb": peak_mb()})
    ratio = rows[1]["linearize"] / rows[0]["linearize"]
    per_6m = rows[1]["linearize"] / rows[1]["samples"] * 6e6
    print(json.dumps({"machine": machine(), "rows": rows, "ratio": ratio, "s_per_6M": per_6m}))


if __name__ == "__main__":
    main()
