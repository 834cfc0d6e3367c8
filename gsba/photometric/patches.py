"""Patches for photometric refinement: spread over the sphere, with depth from the map."""

import functools
from dataclasses import replace

import cv2
import numpy as np
from scipy.ndimage import correlate1d

from factors.patch_windows import PatchTable, PatchViews, over_poles, patch_axes, pixel_grid
from gsba.camera.cameras import Cameras
from gsba.camera.sphere import around_seam, bearings_from_erp, erp_from_bearings
from gsba.frames.masks import load_usable
from gsba.frames.pixels import load_erp
from gsba.geometry import unit
from gsba.types import Counts, FrameSet, Landmarks

_MIN_GRADIENT = 2.0  # grey values per pixel, smallest in a patch
_DEPTH_TOLERANCE = 0.03  # relative, of map points on one plane
SLOPE_SIGMA = 0.7  # prior of a patch's slope, tangent of its tilt
_NUM_PLANE_POINTS = 8  # map points that determine a patch's plane
_MAX_WIDTH = 4096  # pixels of a panorama; wider ones are halved
_SIZE = 9  # pixels across a patch
_SPACING_DEG = 7.0  # between patches of a frame
_MIN_GREY, _MAX_GREY = 3, 252  # grey values beyond which a pixel counts as saturated


def pyramid(frames: FrameSet, frame: int, top: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Grey images (H, 2 H) float32 of a frame, level 0 to `top`, and where level 0 is not masked,
    neither black nor saturated, (H, 2 H) bool. Level 0 is the largest within `_MAX_WIDTH`;
    each further one has half the width, down to 64 pixels, where the levels end."""
    grey = cv2.cvtColor(load_erp(frames, frame), cv2.COLOR_RGB2GRAY).astype(np.float32)
    usable = (grey > _MIN_GREY) & (grey < _MAX_GREY)
    mask = load_usable(frames, frame)
    if mask is not None:
        usable &= mask
    while grey.shape[1] > _MAX_WIDTH and _divides(grey):
        grey = halved(grey)
        usable = coarser(usable, 2)
    levels = [grey]
    while len(levels) <= top and _divides(levels[-1]):
        levels.append(halved(levels[-1]))
    return levels, usable


def halved(grey: np.ndarray) -> np.ndarray:
    """The next level of a pyramid: (H, 2 H) to (H / 2, H) float32, low-passed; H in fours.

    The filter [1 3 3 1] / 8 sits on the corners between pixels, so that bearings stay in place.
    """
    image, rows = np.asarray(grey, dtype=np.float32), 2
    taps = np.array([1, 3, 3, 1], dtype=np.float32) / 8
    tall = correlate1d(over_poles(image, rows), taps, axis=0, origin=-1)[rows:-rows][::2]
    return correlate1d(tall, taps, axis=1, mode="wrap", origin=-1)[:, ::2]


def coarser(usable: np.ndarray, step: int) -> np.ndarray:
    """(H / step, W / step) bool, True if all of step x step pixels (H, W) bool may be used."""
    height, width = usable.shape
    blocks = usable.reshape(height // step, step, width // step, step)
    return np.logical_and.reduce(blocks, axis=(1, 3))


def _divides(image: np.ndarray) -> bool:
    return len(image) % 4 == 0 and len(image) >= 64


def candidates(grey: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Bearings (K, 3) of the best-textured pixel of each cell of an even grid on the sphere."""
    height, width = grey.shape
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    size = (_SIZE, _SIZE)
    across = cv2.Scharr(around_seam(grey, 1), cv2.CV_32F, 1, 0)[:, 1:-1] / (32 * np.cos(latitude))
    down = cv2.Scharr(around_seam(grey, 1), cv2.CV_32F, 0, 1)[:, 1:-1] / 32
    xx, xy, yy = (
        cv2.boxFilter(product.astype(np.float32), -1, size)
        for product in (across * across, across * down, down * down)
    )
    spread = np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
    least, most = 0.5 * (xx + yy) - spread, 0.5 * (xx + yy) + spread
    score = least + 0.05 * most  # weight of an edge's strength, beside that of a corner
    border = 2 * (_SIZE // 2) + 3
    open_ = cv2.erode(usable.astype(np.uint8), np.ones((border, border), np.uint8)) > 0
    open_[:, : border // 2] = open_[:, -(border // 2) :] = False  # erosion does not wrap around the
    # seam
    # beyond 80 degrees, pixels of a panorama are mostly interpolated
    score = np.where(open_ & (np.abs(latitude) < np.deg2rad(80.0)), score, 0.0).ravel()
    order, starts = _cells(width, height, _SPACING_DEG)
    ranked = score[order]
    best = np.maximum.reduceat(ranked, starts)
    cell = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    first = np.full(len(starts), len(order))
    hits = np.flatnonzero(ranked == best[cell])
    np.minimum.at(first, cell[hits], hits)
    chosen = order[first[best > _MIN_GRADIENT**2]]
    v, u = np.divmod(chosen, width)
    return bearings_from_erp(np.column_stack([u + 0.5, v + 0.5]), width, height)


@functools.lru_cache(maxsize=2)
def _cells(width: int, height: int, spacing_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels sorted by cell, and the first one of each cell: rings of equal height."""
    rings = max(1, round(180 / spacing_deg))
    ring = np.minimum(np.arange(height) * rings // height, rings - 1)
    middle = np.pi * ((np.arange(rings) + 0.5) / rings - 0.5)
    columns = np.maximum(1, np.rint(2 * rings * np.cos(middle))).astype(np.int64)
    firsts = np.concatenate([[0], np.cumsum(columns)[:-1]])
    column = np.arange(width)[None, :] * columns[ring][:, None] // width
    cell = (firsts[ring][:, None] + column).ravel()
    order = np.argsort(cell, kind="stable")
    return order, np.flatnonzero(np.diff(cell[order], prepend=-1))


def lay_planes(bearings: np.ndarray, points_rig: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse-depth planes (K, 3), 1 / map units, of patches with unit centres (K, 3), fitted to
    points (M, 3) that the host observes, its rig frame; and (K,) bool, True if the points around
    agree on a plane.

    A plane's inverse depth is linear over the tangent plane, so that a weighted linear fit to the
    nearest points estimates it; a prior on its slopes makes the patch face its host.
    """
    from scipy.spatial import KDTree

    planes, clear = np.zeros((len(bearings), 3)), np.zeros(len(bearings), bool)
    ranges = np.linalg.norm(points_rig, axis=1)
    if len(points_rig) < _NUM_PLANE_POINTS or len(bearings) == 0:
        return planes, clear
    reach = 2 * np.sin(np.deg2rad(6.0) / 2)  # to map points that give the depth
    chords, rows = KDTree(points_rig / ranges[:, None]).query(bearings, k=_NUM_PLANE_POINTS)
    local = np.einsum("pki,pni->pnk", patch_axes(bearings), points_rig[rows])
    ahead = (local[..., 0] > 0) & (chords < reach)
    depth = np.where(ahead, local[..., 0], 1.0)
    x = np.concatenate([np.ones_like(depth[..., None]), local[..., 1:] / depth[..., None]], axis=2)
    y = 1.0 / depth
    weights = np.where(ahead, 1 / (chords**2 + (0.25 * reach) ** 2), 0.0)
    trust = weights
    for _ in range(4):  # reweighted: points of another surface lose weight
        typical = (trust * y).sum(axis=1) / np.maximum(trust.sum(axis=1), 1e-300)
        V = np.einsum("pn,pni,pnj->pij", trust, x, x)
        ridge = (_DEPTH_TOLERANCE / SLOPE_SIGMA) ** 2 * weights.max(axis=1)
        V[:, [1, 2], [1, 2]] += ridge[:, None]
        V += 1e-12 * np.eye(3)
        planes = np.linalg.solve(V, np.einsum("pn,pni,pn->pi", trust, x, y)[..., None])[..., 0]
        off = (np.einsum("pni,pi->pn", x, planes) - y) / np.maximum(typical, 1e-12)[:, None]
        trust = weights / (1 + (off / _DEPTH_TOLERANCE) ** 2)
    agreeing = (ahead & (np.abs(off) < 2 * _DEPTH_TOLERANCE)).sum(axis=1)
    nearest = chords[:, 0] < 0.25 * reach
    agrees = np.abs(off[:, 0]) < _DEPTH_TOLERANCE
    clear = (planes[:, 0] > 0) & (agreeing >= 3) & (agrees | ~nearest)
    clear &= agreeing >= 0.6 * ahead.sum(axis=1)
    return planes, clear


def table_of(
    bearings: list[np.ndarray],
    world_T_rigs: np.ndarray,
    landmarks: Landmarks,
    width: int,
    lenses: Cameras,
) -> tuple[PatchTable, Counts]:
    """Patches of all frames, solved poses (F, 4, 4), with planes from the map, and the frames near
    each host; bearings: of each frame, (K, 3) candidates; width: of the panoramas, pixels."""
    tracks = landmarks.tracks
    positions = world_T_rigs[:, :3, 3]
    hosts, centres, planes, targets = [], [], [], []
    received = 0
    for f, found in enumerate(bearings):
        received += len(found)
        found = found[~lenses.blended(found, np.full(len(found), f))]
        seen = landmarks.points_world[tracks.points[tracks.frames == f]]
        points_rig = (seen - positions[f]) @ world_T_rigs[f, :3, :3]
        shown = lenses.seeing(points_rig, np.full(len(points_rig), f))
        laid, clear = lay_planes(found, shown)
        distances = np.linalg.norm(positions - positions[f], axis=1)
        distances[f] = np.inf
        near = np.argsort(distances, kind="stable")[: min(8, len(positions) - 1)]
        hosts.append(np.full(np.count_nonzero(clear), f))
        centres.append(found[clear])
        planes.append(laid[clear])
        targets.append(np.broadcast_to(near, (int(np.count_nonzero(clear)), len(near))))
    plane = np.concatenate(planes)
    sigmas = [0.2, SLOPE_SIGMA, SLOPE_SIGMA]  # relative, of a patch's depth
    table = PatchTable(
        np.concatenate(hosts),
        np.concatenate(centres),
        plane,
        plane[:, :1] * np.array(sigmas),
        np.arange(len(plane) + 1, dtype=np.int64) * targets[0].shape[1],
        np.concatenate(targets).ravel(),
        pixel_grid(_SIZE, 2 * np.pi / width),
    )
    if lenses:
        table = replace(table, views=views_of(table, world_T_rigs, lenses))
    dropped = {"no clear depth": received - len(plane)}
    return table, Counts(received, len(plane), "patches", dropped)


def views_of(table: PatchTable, world_T_rigs: np.ndarray, lenses: Cameras) -> PatchViews:
    """Views of a table's patches through the lenses of host and target frames."""
    rig_T_hosts = lenses.views(table.bearings_rig, table.hosts)
    world_T_hosts = (world_T_rigs[table.hosts] @ rig_T_hosts)[table.owners]
    centres = (table.bearings_rig / table.planes[:, :1])[table.owners, :, None]
    points = (world_T_hosts[:, :3, :3] @ centres)[:, :, 0] + world_T_hosts[:, :3, 3]
    world_T_targets = world_T_rigs[table.targets]
    away = points - world_T_targets[:, :3, 3]
    local = np.einsum("oji,oj->oi", world_T_targets[:, :3, :3], away)
    shown = unit(lenses.seeing(local, table.targets))
    return PatchViews(rig_T_hosts, lenses.views(shown, table.targets))


def values_at(image: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Values (R,) of a panorama (H, 2H) in directions (R, 3)."""
    height, width = image.shape
    uv = erp_from_bearings(directions, width, height).astype(np.int64)
    return image[np.clip(uv[:, 1], 0, height - 1), uv[:, 0] % width]
