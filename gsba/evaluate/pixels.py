"""Induced pixel error: shift of a frame's points in its neighbours' images by pose errors."""

import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.camera.sphere import bearings_from_erp
from gsba.evaluate.trajectory import TOLERANCE_S
from gsba.log import GsbaError
from gsba.similarity import similarity
from gsba.store.records import HEADER_ERRORS
from gsba.trajectory.association import matched_in_time
from gsba.types import Trajectory

_SPACING_PX = 4  # pixels of a depth map between samples


@dataclass(frozen=True, slots=True)
class InducedErrors:
    """Angles between true and estimated directions to the same points, in panorama pixels."""

    median_px: float
    percentile95_px: float
    steps: tuple[int, ...]  # frames apart
    medians_px: tuple[float, ...]  # of each step
    num_samples: int


def induced_errors(
    estimate: Trajectory,
    truth: Trajectory,
    depth_of: Callable[[int], np.ndarray],
    width: int,
    steps: Sequence[int] = (1, 4),
) -> InducedErrors:
    """Project sampled pixels of each frame into its neighbours, under true and estimated poses.

    A pixel is moved to its true depth, by the true and by the Sim(3)-aligned estimated pose, and is
    projected into the neighbours `steps` frames before and after it by the same poses. The angle
    between both directions is the error that a splat would be trained with.

    Args:
        estimate: estimated poses, associated with the truth by time.
        truth: the true poses.
        depth_of: row of `truth` -> range (h, 2h) along the ray of each pixel of a panorama of
            that size, truth units; 0 = no surface.
        width: width of the full panorama, in whose pixels (at the equator) errors are given.
        steps: frames from a frame to its neighbours.

    Raises:
        GsbaError: fewer than three poses associate, or no frame has a neighbour.
    """
    rows_e, rows_t = matched_in_time(estimate, truth, TOLERANCE_S)
    if len(rows_t) < 3:
        raise GsbaError(
            f"only {len(rows_t)} poses have a true pose within {TOLERANCE_S:g} s; alignment needs 3"
        )
    true_T_rigs = truth.world_T_rigs[rows_t]
    poses = estimate.world_T_rigs[rows_e]
    aligned = similarity(poses[:, :3, 3], true_T_rigs[:, :3, 3]).poses(poses)
    row_of = {int(t): row for row, t in enumerate(rows_t)}
    errors: dict[int, list[np.ndarray]] = {step: [] for step in steps}
    for frame, row in row_of.items():
        points = _points(depth_of(frame))
        for step in steps:
            for other in (row_of.get(frame - step), row_of.get(frame + step)):
                if other is not None:
                    seen = _seen(true_T_rigs[row], true_T_rigs[other], points)
                    shown = _seen(aligned[row], aligned[other], points)
                    across = np.linalg.norm(np.cross(seen, shown), axis=1)
                    errors[step].append(
                        np.arctan2(across, np.einsum("ni,ni->n", seen, shown)) * width / (2 * np.pi)
                    )
    found = {step: np.concatenate(parts) for step, parts in errors.items() if parts}
    found = {step: part for step, part in found.items() if len(part)}
    pooled = np.concatenate(list(found.values())) if found else np.zeros(0)
    if len(pooled) == 0:
        raise GsbaError(
            "no frame with depth has a neighbour: induced errors need depth maps with a distance "
            f"above 0, and two frames that are {' or '.join(map(str, steps))} apart"
        )
    return InducedErrors(
        float(np.median(pooled)),
        float(np.percentile(pooled, 95)),
        tuple(found),
        tuple(float(np.median(part)) for part in found.values()),
        len(pooled),
    )


def depth_maps(folder: Path, num: int) -> Callable[[int], np.ndarray]:
    """Reader of the depth maps `NAME.npz` with a `range` array (h, 2h), in name order.

    Args:
        num: number of true poses, each of which has a map.

    Raises:
        GsbaError: the folder holds another number of maps; the reader raises it for an invalid map.
    """
    files = sorted(folder.glob("*.npz"))
    if len(files) != num:
        raise GsbaError(
            f"{folder}: {len(files)} depth maps for {num} true poses (NAME.npz with an array "
            "`range`, one for each in name order)"
        )

    def read(frame: int) -> np.ndarray:
        path = files[frame]
        try:
            with np.load(path, allow_pickle=False) as archive:
                ranges = archive["range"]
        except (OSError, EOFError, ValueError, KeyError, TypeError, IndexError) as error:
            raise GsbaError(f"{path} holds no array `range` of depths ({error})") from None
        except (zipfile.BadZipFile, zlib.error, NotImplementedError, *HEADER_ERRORS) as error:
            raise GsbaError(f"{path}: damaged depth map ({error})") from None
        if ranges.ndim != 2 or ranges.dtype.kind not in "fiu":
            raise GsbaError(
                f"{path}: `range` has the shape {ranges.shape} and the type {ranges.dtype}, but it "
                "must be an image of numbers"
            )
        if not 0 < 2 * ranges.shape[0] == ranges.shape[1]:
            raise GsbaError(
                f"{path}: `range` is {ranges.shape[1]}x{ranges.shape[0]}, but it must be 2:1"
            )
        return ranges

    return read


def _points(ranges: np.ndarray) -> np.ndarray:
    """Points (N, 3), rig frame, of a grid of pixels of a depth map that have a depth."""
    height, width = ranges.shape
    rows = np.arange(_SPACING_PX // 2, height, _SPACING_PX)
    columns = np.arange(_SPACING_PX // 2, width, _SPACING_PX)
    pixels = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1)
    depths = ranges[np.ix_(rows, columns)].astype(np.float64)
    hit = (depths > 0) & (depths < 1e12)  # larger values mean that nothing was measured
    return depths[hit][:, None] * bearings_from_erp(pixels[hit], width, height)


def _seen(world_T_rig: np.ndarray, world_T_other: np.ndarray, points_rig: np.ndarray) -> np.ndarray:
    """Points (N, 3) of one rig frame in another rig frame."""
    points_world = points_rig @ world_T_rig[:3, :3].T + world_T_rig[:3, 3]
    return (points_world - world_T_other[:3, 3]) @ world_T_other[:3, :3]
