"""Frames of the report as small panoramas with masks, seams, circles and matches to draw in, which
share a budget of bytes."""

import base64
import logging
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from gsba.camera.fisheye import unproject
from gsba.camera.sphere import erp_from_bearings
from gsba.frames.masks import load_mask
from gsba.log import GsbaError
from gsba.report.html.pictures import jpeg_text, residuals_of_rows, small_panorama
from gsba.types import FrameSet, PictureFormat, Reconstruction, rows_across

logger = logging.getLogger(__name__)

MAX_PICTURES = 500
_WIDTH, _LARGE_WIDTH = 256, 512  # pixels across a picture, and across one where there are few
_MASK_WIDTH = 128
_MAX_BYTES = 2_600_000  # of all pictures; a third more in base64
_LARGEST, _LARGEST_WIDE = 9_000, 24_000  # bytes of a picture of either width
_MAX_CANDIDATES, _MAX_MATCHES = 60, 24  # matches of a pair that are looked at, and drawn
_STEPS = 72  # points of a circle or a seam


def frame_pictures(
    frames: FrameSet, reconstruction: Reconstruction, camera: Mapping[str, Any] | None
) -> dict[str, Any]:
    """Pictures of frames, and what is drawn in.

    Args:
        camera: entry "camera" of report.json; None = there is none.

    Returns:
        "shown", frames with a picture, their "jpegs", "masks" as PNGs without repetition and
        "mask" of each shown frame, -1 = none; "cameras" (F,), and of each camera "seams" and
        "circles": lines of places relative to width and height; "matches", see `_matches`.
    """
    num = len(frames)
    wanted = rows_across(num, MAX_PICTURES)
    shown, jpegs, masks, mask = list[int](), list[str](), dict[bytes, int](), list[int]()
    kept, room = dict[Any, int](), _MAX_BYTES // max(len(wanted), 1)
    large = room >= _LARGEST_WIDE
    width, room = (_LARGE_WIDTH, _LARGEST_WIDE) if large else (_WIDTH, min(room, _LARGEST))
    for f in (int(f) for f in wanted):
        try:
            jpegs.append(jpeg_text(small_panorama(frames, f, width), (75, 60, 45, 30, 20), room))
        except GsbaError as error:
            logger.warning("report.html: no image of frame %s (%s)", frames.names[f], error)
            continue
        shown.append(f)
        key = frames.mask_paths[f], int(frames.cameras[f])
        if key not in kept:
            kept[key] = _mask_number(frames, f, masks)
        mask.append(kept[key])
    stitched = camera is not None and bool(camera.get("taken"))
    turned = stitched and bool(camera and camera.get("turned_below_panorama"))
    return {
        "shown": shown,
        "jpegs": jpegs,
        "masks": [base64.b64encode(png).decode("ascii") for png in masks],
        "mask": mask,
        "cameras": frames.cameras,
        "seams": [_seams(kind, stitched and not turned) for kind in frames.formats],
        "circles": [_circles(kind) for kind in frames.formats],
        "matches": _matches(frames, reconstruction),
    }


def _mask_number(frames: FrameSet, f: int, masks: dict[bytes, int]) -> int:
    """Number of a frame's mask among all, which it joins; -1 = it has none, or none readable."""
    import cv2

    try:
        usable = load_mask(frames, f)
    except GsbaError:
        return -1
    if usable is None:
        return -1
    size = _MASK_WIDTH, _MASK_WIDTH // 2
    hidden = cv2.resize((~usable).astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
    image = hidden[..., None] * np.array((40, 40, 220, 150), np.uint8)
    png = cv2.imencode(".png", image)[1].tobytes()
    return masks.setdefault(png, len(masks))


def _seams(kind: PictureFormat, two_lenses: bool) -> list[np.ndarray]:
    """Lines (N, 2) where pictures of two lenses along the z axis meet."""
    raw = kind.fisheyes is not None and len(kind.fisheyes) == 2
    if not raw and not (two_lenses and kind.panoramic):
        return []
    angles = np.linspace(0, 2 * np.pi, _STEPS + 1)
    return [_places(np.column_stack([np.cos(angles), np.sin(angles), 0 * angles]))]


def _circles(kind: PictureFormat) -> list[np.ndarray]:
    """Lines (N, 2) along the edge of each lens's picture."""
    lines, angles = [], np.linspace(0, 2 * np.pi, _STEPS + 1)
    edge = np.column_stack([np.cos(angles), np.sin(angles)])
    for lens in kind.fisheyes or ():
        pixels = np.array(lens.principal) + min(lens.width, lens.height) / 2 * edge
        lines.append(_places(unproject(lens, pixels)))
    return lines


def _places(bearings: np.ndarray) -> np.ndarray:
    return erp_from_bearings(bearings, 1, 1).round(4)


def _matches(frames: FrameSet, reconstruction: Reconstruction) -> dict[str, Any]:
    """Points that frames share with the next one, the worst half of them among those.

    Returns:
        "shared" (F - 1,), numbers of shared points; "counts" (F - 1,), numbers of drawn ones;
        "data", base64 of (N, 5) uint16 little-endian: places in both frames relative to width and
        height, in 1/65535, and the larger residual of the two in 1/1000 degree.
    """
    observed = reconstruction.observations_by_frame()
    owners = frames.recording_of_frame
    shared, chosen = np.zeros(max(len(frames) - 1, 0), int), []
    for f in range(len(shared)):
        if owners[f] != owners[f + 1]:
            continue
        rows, others = observed[f], observed[f + 1]
        points = reconstruction.observation_points
        _, a, b = np.intersect1d(points[rows], points[others], return_indices=True)
        shared[f] = len(a)
        some = rows_across(len(a), _MAX_CANDIDATES)
        chosen.append(np.column_stack([np.full(len(some), f), rows[a[some]], others[b[some]]]))
    pairs = np.concatenate(chosen) if chosen else np.zeros((0, 3), int)
    lengths = [
        np.linalg.norm(residuals_of_rows(reconstruction, pairs[:, k]), axis=1) for k in (1, 2)
    ]
    worst = np.degrees(np.max(lengths, axis=0))
    most = _MAX_MATCHES // (2 if len(frames) > 1000 else 1)
    kept = _some_and_worst(pairs[:, 0], worst, most)
    pairs, worst = pairs[kept], worst[kept]
    bearings = [reconstruction.observation_bearings[pairs[:, k]] for k in (1, 2)]
    places = np.hstack([np.mod(erp_from_bearings(each, 1, 1), 1.0) for each in bearings])
    values = np.column_stack([65535 * places, 1000 * worst])
    packed = np.clip(np.rint(np.nan_to_num(values)), 0, 65535).astype("<u2")
    return {
        "shared": shared,
        "counts": np.bincount(pairs[:, 0], minlength=len(shared)),
        "data": base64.b64encode(packed.tobytes()).decode("ascii"),
    }


def _some_and_worst(pairs: np.ndarray, worst: np.ndarray, most: int) -> np.ndarray:
    """Rows (N',) of at most `most` matches of each pair: the worst half, and some of the others."""
    kept = []
    bounds = np.flatnonzero(np.diff(pairs, prepend=-1, append=-1))
    for first, end in pairwise(bounds):
        order = first + np.argsort(-worst[first:end], kind="stable")
        rest = order[most // 2 :]
        evenly = rows_across(len(rest), most - most // 2)
        kept.append(np.sort(np.concatenate([order[: most // 2], rest[evenly]])))
    return np.concatenate(kept) if kept else np.zeros(0, int)
