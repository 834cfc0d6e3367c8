"""Direction of gravity by an accelerometer, tags or the rigs, refined by vertical edges."""

import logging
from dataclasses import dataclass

import cv2
import numpy as np

from gsba.camera.rig import CubeRig
from gsba.frames import cubemap
from gsba.frames.files import image_header
from gsba.geometry import median_direction
from gsba.types import FACES, FrameSet, PoseStatus, Reconstruction, rows_across

logger = logging.getLogger(__name__)

_FACE_PX = 640
_MIN_SPREAD = 0.1  # of the edges' directions around the vertical: 0 = all in one plane, 1 = even
_MAX_SPREAD_DEG = 30.0  # of the rigs' up axes; above it, they have no common axis


@dataclass(frozen=True, slots=True)
class Gravity:
    """Direction of up in the world of a reconstruction."""

    up: np.ndarray  # (3,) float64, unit
    by_rigs: np.ndarray  # (3,) float64, unit, the rigs' common up axis
    spread_deg: float  # median angle of a rig's up axis to the common one
    num_edges: int  # number of inlier edges; 0 = up is that of the rigs or the accelerometer
    by_forces: np.ndarray | None = None  # (3,) float64, unit, by an accelerometer; None = none
    by_tags: np.ndarray | None = None  # (3,) float64, unit, by GPano tags; None = none, or an
    # accelerometer rode along

    @property
    def turn_deg(self) -> float:
        """Angle between `up` and the rigs' up axis."""
        return degrees_off(self.up, self.by_rigs)


def estimate_gravity(reconstruction: Reconstruction, frames: FrameSet) -> Gravity | None:
    """Direction of up; None if there is no accelerometer and the rigs have no common up axis.

    The initial direction is that of an accelerometer, accurate to its bias of some tenths of a
    degree, else by pitch and roll in GPano tags, if these agree with the poses, else the geometric
    median of the rigs' up axes, accurate to some degrees. Vertical edges
    (doors, walls, posts) refine it: the plane through the camera and such an edge holds the
    vertical, so that its normal is level. The refined direction is the smallest principal axis of
    the normals of edges from all around, in tightening gates (after Kosecka and Zhang, Video
    Compass, ECCV 2002).

    Args:
        frames: frames of the run; the images of a few are read.
    """
    good = np.flatnonzero(reconstruction.pose_statuses == PoseStatus.REFINED)
    if not len(good):
        return None
    ups = -reconstruction.world_T_rigs[good, :3, 1]
    by_rigs, forces = median_direction(ups), reconstruction.vertical
    spread = degrees_off(ups, by_rigs)
    if forces is not None and forces @ by_rigs < 0 and spread <= _MAX_SPREAD_DEG:
        forces = -forces  # its sign differs between makers
    tags = _up_by_tags(reconstruction, frames, good, spread) if forces is None else None
    if spread > _MAX_SPREAD_DEG and forces is None and tags is None:
        logger.warning("the rigs have no common up axis (median deviation %.0f degrees)", spread)
        return None
    chosen = good[rows_across(len(good), 24)]
    found = [_edge_normals(frames, int(f), reconstruction.world_T_rigs[f]) for f in chosen]
    normals, weights = (np.concatenate(part) for part in zip(*found, strict=True))
    start, most, source = by_rigs, 10.0, "the rigs' up axis"
    if forces is not None:
        start, most, source = forces, 2.0, "the accelerometer"
    elif tags is not None:
        start, most, source = tags, 4.0, "the GPano tags"
    up, num_edges = _level_axis(normals, weights, start)
    gravity = Gravity(up, by_rigs, spread, num_edges, forces, tags)
    if (off := degrees_off(up, start)) > most:
        logger.warning(
            "vertical edges are not used: they deviate by %.1f degrees from %s", off, source
        )
        gravity = Gravity(start, by_rigs, spread, 0, forces, tags)
    logger.info(
        "up: %d vertical edges, %.2f degrees from the rigs' up axis (median deviation %.2f)",
        gravity.num_edges,
        gravity.turn_deg,
        spread,
    )
    return gravity


def _up_by_tags(
    reconstruction: Reconstruction, frames: FrameSet, good: np.ndarray, spread_deg: float
) -> np.ndarray | None:
    """Up axis (3,) by pitch and roll in the GPano tags of frames `good` (G,); None = there are
    none, or they contradict the poses.

    Signs differ between makers, and some tag a pose that they have already undone: of both signs
    of each angle those are taken under which the frames' up axes agree best, and better than the
    rigs' own axes, which deviate by `spread_deg`.
    """
    angles = np.radians([_tilt_deg(frames, f) for f in good.tolist()])
    known = np.isfinite(angles).all(axis=1)
    if np.count_nonzero(known) < 3 or not np.ptp(angles[known], axis=0).any():
        return None
    (pitch, roll), found = angles[known].T, []
    for ahead, aside in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        ups = np.column_stack(
            [
                aside * np.sin(roll) * np.cos(pitch),
                -np.cos(roll) * np.cos(pitch),
                ahead * np.sin(pitch),
            ]
        )
        ups = np.einsum("gij,gj->gi", reconstruction.world_T_rigs[good[known], :3, :3], ups)
        up = median_direction(ups)
        found.append((degrees_off(ups, up), up))
    off, up = min(found, key=lambda one: one[0])
    return up if off < min(spread_deg, 4.0) else None  # above it, they contradict the poses


def _tilt_deg(frames: FrameSet, f: int) -> tuple[float, float]:
    """Pitch and roll of a panorama by its GPano tags; NaN = not given."""
    if frames.format_of(f).layout != "erp":
        return np.nan, np.nan
    tags = image_header(frames.paths[f][0]).tags
    return (np.nan, np.nan) if tags is None else tags.attitude_deg[1:]


def degrees_off(directions: np.ndarray, axis: np.ndarray) -> float:
    """Angle of a unit vector (3,), or median angle of several (N, 3), to a unit axis (3,)."""
    return float(np.degrees(np.median(np.arccos(np.clip(directions @ axis, -1, 1)))))


def _edge_normals(
    frames: FrameSet, f: int, world_T_rig: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normals (E, 3), world, of the planes through straight edges, and their lengths (E,), rad."""
    assert FACES[:4] == ("front", "right", "back", "left")
    images, masks = cubemap.load(frames, f, cubemap.native_rig(frames.format_of(f), _FACE_PX))
    images = images[:4]
    rig = CubeRig(images.shape[1], np.pi / 2)
    detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD)
    normals, lengths = [np.zeros((0, 3))], [np.zeros(0)]
    for face, image in enumerate(images):
        lines = detector.detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[0]
        if lines is None:
            continue
        ends = lines.reshape(-1, 2, 2).astype(np.float64) + 0.5
        long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= 40.0 * rig.size / _FACE_PX
        if masks is not None:
            middle = np.clip(ends.mean(axis=1).astype(int), 0, rig.size - 1)
            long &= masks[face][middle[:, 1], middle[:, 0]]
        rays = rig.bearings(ends[long], face)
        across = np.cross(rays[:, 0], rays[:, 1])
        sine = np.linalg.norm(across, axis=1)
        normals.append(across / np.maximum(sine, 1e-12)[:, None] @ world_T_rig[:3, :3].T)
        lengths.append(np.arcsin(np.clip(sine, 0, 1)))
    return np.concatenate(normals), np.concatenate(lengths)


def _level_axis(
    normals: np.ndarray, weights: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, int]:
    """Axis (3,) near `start` perpendicular to most normals, and their number; 0 = `start`."""
    up, near = start, np.zeros(len(normals), bool)
    for gate in (8.0, 4.0, 2.0, 1.0, 0.6):
        for _ in range(5):
            near = np.abs(normals @ up) < np.sin(np.deg2rad(gate))
            if near.sum() < 40:
                return start, 0
            weighted = normals[near] * weights[near, None]
            values, axes = np.linalg.eigh(weighted.T @ weighted)
            if values[1] < _MIN_SPREAD * values[2]:
                return start, 0
            up = axes[:, 0] * np.sign(axes[:, 0] @ start)
    return up, int(near.sum())
