"""Traits of each extractor, from panoramas that are turned about all axes.

    python benchmarks/learned.py OUT.md PANORAMA [PANORAMA ...] [--size 384] [--extractors sift,...]

Of mutual nearest neighbours of a panorama and the same one turned, the rotation tells which are
true. Medians and quantiles of these give `gsba.features.detection.TRAITS`. Weights come from
the packages of the extra `weights`; a name such as aliked-n32.pth chooses a model.
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from gsba.camera.rig import CubeRig
from gsba.camera.sphere import around_seam, bearings_from_erp, erp_from_bearings
from gsba.config import RefineSettings
from gsba.features import detection
from gsba.frames import cubemap
from gsba.learned import find_weights, make_extractor
from gsba.types import Features

_TRUE_PX, _FALSE_PX = 2.0, 6.0  # of a match's error
_NUM_TURNS = 3
_SAME_PLACE = 0.01  # chord between keypoints that are one, for the second best
_MEDIAN_OF_TWO = 1.1774 * np.sqrt(2)  # median distance of two keypoints, per-axis sigmas of one
_HEADER = (
    "| extractor | panorama | true of mutual | error px | offset u, v | sigma px | "
    "cosine of true 5 %, 50 % | of false 50 %, 90 % | ratio of true 90 %, 95 % | CPU s a face |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)


def turned(
    panorama: np.ndarray, rotation: np.ndarray, interpolation: int = cv2.INTER_LANCZOS4
) -> np.ndarray:
    """The panorama (H, W, 3) of a camera turned by `rotation` (3, 3)."""
    height, width = panorama.shape[:2]
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    return sampled(panorama, bearings_from_erp(pixels, width, height) @ rotation.T, interpolation)


def sampled(panorama: np.ndarray, rays: np.ndarray, interpolation: int) -> np.ndarray:
    """The panorama's values (..., C) in directions rays (..., 3)."""
    height, width = panorama.shape[:2]
    u, v = np.moveaxis(erp_from_bearings(rays, width, height), -1, 0)
    places = (u + 7.5).astype(np.float32), (v - 0.5).astype(np.float32)
    padded = around_seam(panorama, 8)
    return cv2.remap(padded, *places, interpolation, borderMode=cv2.BORDER_REPLICATE)


def mutual_matches(first: Features, second: Features) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mutual nearest neighbours (m, 2), their cosines (m,) and ratios of distances (m,)."""
    one, other = (
        found.descriptors / np.linalg.norm(found.descriptors.astype(np.float32), axis=1)[:, None]
        for found in (first, second)
    )
    alike = one @ other.T
    nearest = alike.argmax(axis=1)
    rows = np.flatnonzero(alike.argmax(axis=0)[nearest] == np.arange(len(alike)))
    partners = nearest[rows]
    cosines, rest = alike[rows, partners], alike[rows]
    for row, partner in zip(rest, partners, strict=True):
        here = second.bearings_rig - second.bearings_rig[partner]
        row[np.abs(here).max(axis=1) < _SAME_PLACE] = -1
    ratios = np.sqrt((1 - cosines) / np.maximum(1 - rest.max(axis=1), 1e-6))
    return np.column_stack([rows, partners]), cosines, ratios


def fitted_offset(pairs: list[tuple], rig: CubeRig) -> tuple[np.ndarray, float]:
    """Offset (2,) of all keypoints, pixels, that leaves the least median error, and this error."""

    def median(offset: np.ndarray) -> float:
        errors = []
        for (pixels0, faces0), (pixels1, faces1), rotation in pairs:
            rays = rig.bearings(pixels0 + offset, faces0) @ rotation
            errors.append(np.linalg.norm(rig.project(rays, faces1) - pixels1 - offset, axis=1))
        return float(np.median(np.concatenate(errors)))

    best, least = np.zeros(2), median(np.zeros(2))
    for step in (0.25, 0.1, 0.03):
        middle = best
        for u in range(-3, 4):
            for v in range(-3, 4):
                offset = middle + step * np.array([u, v])
                error = median(offset)
                if error < least:
                    best, least = offset, error
    return best, least


def measure(name: str, path: Path, size: int) -> str:
    """The row of an extractor, or of a model by its file, on one panorama."""
    chosen = {"extractor": name.partition("-")[0], "weights": name if "." in name else None}
    settings = RefineSettings.model_validate({"features": chosen})
    extractor = make_extractor(settings.features, find_weights(settings))()
    rig = CubeRig(size, np.deg2rad(cubemap.HFOV_DEG))
    panorama = np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB))
    start = time.process_time()
    first = detection.extract(cubemap.cut(panorama, rig), None, rig, extractor)
    cost = (time.process_time() - start) / 6
    pairs, columns, rng = [], [], np.random.default_rng(0)
    for _ in range(_NUM_TURNS):
        angles = rng.uniform((-25, 30, -25), (25, 60, 25))
        rotation = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
        faces = cubemap.cut(turned(panorama, rotation), rig)
        second = detection.extract(faces, None, rig, extractor)
        matches, cosines, ratios = mutual_matches(first, second)
        i, j = matches.T
        seen = rig.project(first.bearings_rig[i] @ rotation, second.faces[j])
        off = np.linalg.norm(seen - second.pixels[j], axis=1)
        columns.append((off, cosines, ratios))
        i, j = matches[off < _TRUE_PX].T
        ends = (first.pixels[i], first.faces[i]), (second.pixels[j], second.faces[j])
        pairs.append((*ends, rotation))
    off, cosines, ratios = map(np.concatenate, zip(*columns, strict=True))
    true, false = off < _TRUE_PX, off > _FALSE_PX
    offset, error = fitted_offset(pairs, rig)
    quantiles = [
        np.quantile(some, shares)
        for some, shares in (
            (cosines[true], (0.05, 0.5)),
            (cosines[false], (0.5, 0.9)),
            (ratios[true], (0.9, 0.95)),
        )
    ]
    cells = [f"{low:.2f}, {high:.2f}" for low, high in quantiles]
    cells = [f"{offset[0]:+.2f}, {offset[1]:+.2f}", f"{error / _MEDIAN_OF_TWO:.2f}", *cells]
    counts = f"{true.sum()} of {len(off)}", f"{np.median(off[true]):.2f}"
    return f"| {' | '.join((name, path.stem, *counts, *cells, f'{cost:.2f}'))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("panoramas", type=Path, nargs="+")
    parser.add_argument("--size", type=int, default=384, help="pixels of a face")
    parser.add_argument("--extractors", default="sift,aliked-n16.pth,aliked-n16rot.pth,disk,xfeat")
    given = parser.parse_args()
    rows = [
        measure(n, path, given.size)
        for n in given.extractors.split(",")
        for path in given.panoramas
    ]
    given.out.write_text("\n".join([_HEADER, *rows, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
