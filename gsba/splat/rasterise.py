"""Render Gaussians on the CPU: colour, expected depth and alpha, with analytic gradients.

The image model of Kerbl et al., 3D Gaussian Splatting for Real-Time Radiance Field Rendering,
2023: splats sorted by depth and blended from near to far over black. A splat is blended where its
alpha is 1/255 or more (its tiles and rows are bounded by exactly that ellipse), alpha is at most
0.99, and a pixel that lets less than 1e-4 through receives no more splats.
"""

import functools
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from factors.threads import run_in_threads
from gsba.splat import _project, _tiles
from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians, zeros_like


@dataclass(frozen=True, slots=True)
class Rendering:
    """An image of a splat."""

    color: np.ndarray  # (H, W, 3) float32, 0 = black; without upper limit
    depth: np.ndarray  # (H, W) float32, expected z in map units where alpha > 0, else 0
    alpha: np.ndarray  # (H, W) float32, 0..1


@dataclass(frozen=True, slots=True)
class Gradients:
    """Derivatives of a loss with respect to a splat."""

    gaussians: Gaussians  # derivatives by every parameter
    centres: np.ndarray  # (N, 2) float32, derivatives by the projected centres, per pixel
    seen: np.ndarray  # (N,) bool, Gaussians that reach into the image


@dataclass(frozen=True, slots=True)
class Tape:
    """Intermediate results of a rendering, kept for its gradients."""

    gaussians: Gaussians
    camera: FaceCamera
    sh_degree: int
    splats: np.ndarray  # (N, 10) float32, see _tiles
    reach2: np.ndarray  # (N,) float32, 0 = not rendered
    offsets: np.ndarray  # (N + 1,) int64, entries of each splat
    starts: np.ndarray  # (tiles + 1,) int64, rows of each tile
    owners: np.ndarray  # (E,) int32, splat of each row
    entries: np.ndarray  # (E,) int64, entry of each row
    used: np.ndarray  # (tiles,) int64, rows blended
    image: np.ndarray  # (5, rows * 16, columns * 16) float32


def render(
    gaussians: Gaussians,
    camera: FaceCamera,
    sh_degree: int | None = None,
    near: float = 1e-2,
    num_threads: int | None = None,
) -> tuple[Rendering, Tape]:
    """The image of a splat, and the tape for `differentiate`; sh_degree: highest degree of
    harmonics to use, None = all; near: least z of a Gaussian's mean, map units. Results do not
    depend on the number of threads, None = all cores."""
    degree = gaussians.usable_degree(sh_degree)
    num = len(gaussians)
    across, down = (-(-pixels // _tiles.TILE) for pixels in (camera.width, camera.height))
    splats, reach2 = np.empty((num, 10), np.float32), np.empty(num, np.float32)
    given = (camera.packed(), near, *map(np.ascontiguousarray, gaussians.arrays()), degree)
    run = functools.partial(_in_parallel, num_threads or os.cpu_count() or 1)
    run(num, 2048, _project.project, *given, splats, reach2)
    offsets = np.zeros(num + 1, np.int64)
    counts = offsets[1:]
    run(num, 8192, _tiles.count_tiles, splats, reach2, down, across, counts)
    np.cumsum(counts, out=counts)
    seen = np.flatnonzero(reach2)
    order = seen[np.argsort(splats[seen, 9], kind="stable")]
    starts = np.empty(down * across + 1, np.int64)
    owners, entries = np.empty(offsets[-1], np.int32), np.empty(offsets[-1], np.int64)
    _tiles.fill_tiles(splats, reach2, order, offsets, down, across, starts, owners, entries)
    image = np.empty((_tiles.CHANNELS, down * _tiles.TILE, across * _tiles.TILE), np.float32)
    used = np.empty(down * across, np.int64)
    given = (splats, reach2, starts, owners, across, image, used)
    run(down * across, 8, _tiles.blend_tiles, *given)
    tape = Tape(
        gaussians, camera, degree, splats, reach2, offsets, starts, owners, entries, used, image
    )
    shown = image[:, : camera.height, : camera.width]
    alpha = shown[4]
    depth = np.divide(shown[3], alpha, out=np.zeros_like(alpha), where=alpha > 0)
    color = np.ascontiguousarray(np.moveaxis(shown[:3], 0, -1))
    return Rendering(color, depth, alpha.copy()), tape


def differentiate(
    tape: Tape,
    d_color: np.ndarray,
    d_depth: np.ndarray | None = None,
    d_alpha: np.ndarray | None = None,
    num_threads: int | None = None,
) -> Gradients:
    """Gradients of a loss from its derivatives by a rendering's colour (H, W, 3), and by its
    expected depth and alpha (H, W), None = zero; tape: of that rendering."""
    image, slopes = tape.image, np.zeros_like(tape.image)
    inside = np.s_[:, : tape.camera.height, : tape.camera.width]
    shown, sloped = image[inside], slopes[inside]
    sloped[:3] = np.moveaxis(d_color, -1, 0)
    if d_depth is not None:
        alpha = shown[4]
        share = np.divide(d_depth, alpha, out=np.zeros_like(alpha), where=alpha > 0)
        sloped[3] = share
        depth = np.divide(shown[3], alpha, out=np.zeros_like(alpha), where=alpha > 0)
        sloped[4] -= share * depth
    if d_alpha is not None:
        sloped[4] += d_alpha
    run = functools.partial(_in_parallel, num_threads or os.cpu_count() or 1)
    across, num = image.shape[2] // _tiles.TILE, len(tape.reach2)
    shares = np.zeros((len(tape.entries), 10), np.float32)
    rows = (tape.splats, tape.reach2, tape.starts, tape.owners, tape.entries)
    given = (*rows, across, image, slopes, tape.used, shares)
    run(len(tape.used), 8, _tiles.differentiate_tiles, *given)
    d_splats = np.empty((num, 10), np.float32)
    run(num, 4096, _tiles.sum_entries, tape.offsets, shares, d_splats)
    out = zeros_like(tape.gaussians)
    means, log_scales, quaternions, _, sh = tape.gaussians.arrays()
    given = (tape.camera.packed(), means, log_scales, quaternions, sh, tape.sh_degree)
    given = (*given, tape.splats, tape.reach2, d_splats, *out.arrays())
    run(num, 2048, _project.backproject, *given)
    return Gradients(out, d_splats[:, :2].copy(), tape.reach2 > 0)


def _in_parallel(
    num_threads: int, num: int, grain: int, kernel: Callable[..., object], *given: Any
) -> None:
    """Call kernel(*given, begin, end) on ranges of `grain` items that cover 0..num - 1."""

    def work(i: int) -> None:
        kernel(*given, grain * i, min(grain * (i + 1), num))

    run_in_threads(work, -(-num // grain), num_threads)
