"""Speed of the CPU rasteriser: forward and backward pass of one face, and growth of the cost.

    python benchmarks/splat_speed.py

Gaussians of about two pixels are rendered on a face; times are the smallest of several calls.
Ratios are the cost of a pixel, or of a splat in a tile, at four times the number over that at the
number itself: 1 is linear. The last lines state whether the targets hold; the exit code is 1 if one
is missed.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from common import machine

from gsba.camera.rig import CubeRig
from gsba.splat.camera import face_camera
from gsba.splat.gaussians import Gaussians
from gsba.splat.rasterise import differentiate, render

MAX_MS = 100.0  # 20,000 Gaussians, 256 x 256 pixels, forward and backward, on two cores
MAX_GROWTH = 1.3  # of the cost of a pixel or of an entry, at four times the number
CASES = {
    "base": (20_000, 256, 0.0),
    "4x pixels": (80_000, 512, 0.0),
    "base, faint": (20_000, 256, -3.0),
    "4x splats a tile, faint": (80_000, 256, -3.0),
}


@dataclass(frozen=True, slots=True)
class Row:
    """Times of one case."""

    gaussians: int
    size: int  # pixels
    entries: int  # splats in tiles, blended ones only
    forward_ms: float  # wall clock
    backward_ms: float
    cpu_ms: float  # both, all threads


def scene(num: int, size: int, logit: float) -> Gaussians:
    """Gaussians whose images are about two pixels wide, opacities around a logit."""
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 8, num)
    width = np.log(2 * z / (size / 2))[:, None]
    return Gaussians(
        np.column_stack([rng.uniform(-1, 1, (num, 2)) * z[:, None], z]).astype(np.float32),
        (width + rng.normal(0, 0.5, (num, 3))).astype(np.float32),
        rng.normal(size=(num, 4)).astype(np.float32),
        (logit + rng.normal(0, 2 if logit == 0 else 0.3, num)).astype(np.float32),
        rng.normal(0, 0.3, (num, 16, 3)).astype(np.float32),
    )


def run(num: int, size: int, logit: float, repeats: int, num_threads: int) -> Row:
    """Row with the smallest times of several calls."""
    gaussians, camera = scene(num, size, logit), face_camera(np.eye(4), 0, CubeRig(size, np.pi / 2))
    d_color = np.random.default_rng(1).normal(size=(size, size, 3)).astype(np.float32)
    forward, backward, cpu, entries = [], [], [], 0
    for _ in range(repeats + 1):
        cpu_start, start = time.process_time(), time.perf_counter()
        _, tape = render(gaussians, camera, num_threads=num_threads)
        middle = time.perf_counter()
        differentiate(tape, d_color, num_threads=num_threads)
        forward.append(1e3 * (middle - start))
        backward.append(1e3 * (time.perf_counter() - middle))
        cpu.append(1e3 * (time.process_time() - cpu_start))
        entries = int(tape.used.sum())
    return Row(num, size, entries, min(forward[1:]), min(backward[1:]), min(cpu[1:]))


def verdicts(rows: dict[str, Row]) -> list[tuple[str, bool]]:
    """Targets with the measured figures, and True if they hold."""
    base, wide, faint, deep = rows.values()
    wall = base.forward_ms + base.backward_ms
    per_pixel = wide.cpu_ms / wide.size**2 / (base.cpu_ms / base.size**2)
    per_entry = deep.cpu_ms / deep.entries / (faint.cpu_ms / faint.entries)
    return [
        (f"base: {wall:.0f} ms forward and backward, at most {MAX_MS:.0f}", wall <= MAX_MS),
        (f"4x pixels: a pixel costs {per_pixel:.2f}x", per_pixel <= MAX_GROWTH),
        (f"4x splats a tile: an entry costs {per_entry:.2f}x", per_entry <= MAX_GROWTH),
    ]


def main() -> None:
    """Run, print; exit with 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=min(os.cpu_count() or 1, 2))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"{machine()}, {options.threads} threads")
    print(f"{'':24} {'Gaussians':>9} {'face':>5} {'entries':>8} {'fwd ms':>7} {'bwd ms':>7} CPU ms")
    rows = {}
    for name, case in CASES.items():
        row = rows[name] = run(*case, options.repeats, options.threads)
        print(
            f"{name:24} {row.gaussians:9d} {row.size:5d} {row.entries:8d} {row.forward_ms:7.1f} "
            f"{row.backward_ms:7.1f} {row.cpu_ms:6.1f}",
            flush=True,
        )
    judged = verdicts(rows)
    for text, held in judged:
        print(f"{'ok  ' if held else 'MISS'} {text}")
    if options.json:
        report = {name: asdict(row) for name, row in rows.items()}
        options.json.write_text(json.dumps({"machine": machine(), "rows": report}, indent=2) + "\n")
    sys.exit(0 if all(held for _, held in judged) else 1)


if __name__ == "__main__":
    main()
