"""What there is to see of a finished run, as arrays in one world."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.optics import ONE_EYE, Optics
from gsba.camera.views import View
from gsba.evaluate.scans import colors_of
from gsba.frames import cubemap, lens_faces
from gsba.frames.masks import load_mask
from gsba.geometry import rotation_from_quaternion
from gsba.log import GsbaError
from gsba.placement.placement import Placement, read_placement
from gsba.report.html.figures import viewing_axes
from gsba.splat.gaussians import SH_CONSTANT, Gaussians
from gsba.splat.ply import read_ply
from gsba.store.finished import load_lenses, load_run
from gsba.trajectory.files import read_trajectory
from gsba.types import FACES, FrameSet, Reconstruction

logger = logging.getLogger(__name__)

_MAX_FACE = 768  # pixels of a shown cube face
_MASKED = np.array([192, 57, 43])  # what masks leave out is tinted in this colour
_TINT = 0.6  # its share there


@dataclass(frozen=True, slots=True)
class Splat:
    """Gaussians as viewers want them: without harmonics beyond the constant one."""

    name: str
    means: np.ndarray  # (N, 3) float32, world of the scene
    covariances: np.ndarray  # (N, 3, 3) float32, squared units of that world
    colors: np.ndarray  # (N, 3) float32, RGB, 0..1
    opacities: np.ndarray  # (N, 1) float32, 0..1


@dataclass(frozen=True, slots=True)
class Scene:
    """A run and what has been made of it, in one world."""

    name: str
    frames: FrameSet
    reconstruction: Reconstruction  # refined poses and cloud
    coarse_T_rigs: np.ndarray | None  # (F, 4, 4) float64 poses before; None = there were none
    splats: tuple[Splat, ...]
    up: np.ndarray  # (3,) float64, unit
    unit: str  # of the world: "map units", "m", ...
    grounds: str  # what places the world, for people
    step: float  # median distance of neighbouring frames, > 0: how large to draw things
    optics: Optics = ONE_EYE  # of the frames, unit of the world
    judged: tuple[np.ndarray, np.ndarray] | None = None  # points (N, 3) and colours (N, 3) uint8
    # by their distance to a scan; None = compared with none


def load_scene(run: Path) -> Scene:
    """Everything of a finished run that can be shown.

    Of several maps the largest is shown. Its world is that of the run's last export which placed it
    elsewhere (upright, in metres, by GPS or truth), or else the run's own; splats in RUN/splat are
    carried along.

    Raises:
        GsbaError: no finished run, or a splat or transform.json that cannot be read.
    """
    reconstruction, frames = load_run(run)
    placement, grounds = _latest_placement(run)
    placed = placement.apply(reconstruction)
    axes, _ = viewing_axes(placed.world_T_rigs)
    splats = (
        _placed_splat(path.parent.name, read_ply(path), placement)
        for path in sorted(run.glob("splat/*/point_cloud.ply"))
    )
    lenses = load_lenses(run, reconstruction).scaled(placement.similarity.scale)
    steps = np.linalg.norm(np.diff(placed.world_T_rigs[:, :3, 3], axis=0), axis=1)
    moving = steps[steps > 1e-9 * (1 + steps.max(initial=0))]
    return Scene(
        name=run.resolve().name,
        frames=frames,
        reconstruction=placed,
        coarse_T_rigs=_coarse(run, placement, len(frames)),
        splats=tuple(splats),
        up=_UPS[placement.up] if placement.up in _UPS else axes[2],
        unit=placement.unit,
        grounds=grounds,
        step=float(np.median(moving)) if len(moving) else 1.0,
        optics=Optics.of(lenses, placed),
        judged=_judged(run, placed),
    )


def _judged(run: Path, placed: Reconstruction) -> tuple[np.ndarray, np.ndarray] | None:
    """What `gsba evaluate --scan` has found of the run's points, if they are still these."""
    path = run / "scan.json"
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["points"]
        rows, distances = np.array(found["rows"], np.int64), np.array(found["distances"])
        if found["of"] != len(placed.points_world):
            logger.warning("%s is of an earlier run: its colours are left out", path)
            return None
        return placed.points_world[rows], colors_of(distances, found["furthest"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        raise GsbaError(f"{path}: cannot be read: evaluate with --scan again") from None


_UPS = {"-y": np.array([0.0, -1, 0]), "y": np.array([0.0, 1, 0]), "z": np.array([0.0, 0, 1])}


def faces_of(
    frames: FrameSet, f: int, masked: bool, optics: Optics = ONE_EYE
) -> dict[str, np.ndarray]:
    """The faces of a frame, by the names of the views that `views_of` has, uint8 RGB.

    Args:
        frames: panoramas or cube faces; faces that were never taken are left out.
        f: the frame.
        masked: tint what its mask leaves out.
        optics: of the frames.

    Raises:
        GsbaError: pictures that have vanished or changed since the run.
    """
    if optics:
        return _lens_faces(frames, f, masked, optics)
    rig = cubemap.native_rig(frames, _MAX_FACE)
    images, use = cubemap.load(frames, f, rig)
    if masked and use is not None and frames.mask_paths[f] is not None:
        images = _tinted(images, use)
    names = frames.faces or FACES
    return {name: _shrunk(images[FACES.index(name)]) for name in names}


def views_of(frames: FrameSet, optics: Optics) -> tuple[View, ...]:
    """What the shown pictures of a frame are."""
    return optics.views(min(frames.native_face_size, _MAX_FACE))


def _lens_faces(frames: FrameSet, f: int, masked: bool, optics: Optics) -> dict[str, np.ndarray]:
    views = views_of(frames, optics)
    cutter = optics.cutter(views, f)
    images, mask = lens_faces.cut(frames, f, cutter), load_mask(frames, f) if masked else None
    if mask is not None:
        pairs = zip(images, cutter.cut_mask(mask), strict=True)
        images = [_tinted(image, use) for image, use in pairs]
    return {view.name: image for view, image in zip(views, images, strict=True)}


def _tinted(image: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Pictures (..., 3) with what is not used (...) bool in another colour."""
    tinted = np.round((1 - _TINT) * image + _TINT * _MASKED).astype(np.uint8)
    return np.where(use[..., None], image, tinted)


def _shrunk(image: np.ndarray) -> np.ndarray:
    if len(image) <= _MAX_FACE:
        return image
    return cv2.resize(image, (_MAX_FACE, _MAX_FACE), interpolation=cv2.INTER_AREA)


def _latest_placement(run: Path) -> tuple[Placement, str]:
    """Where the run's latest export that moved it has put the world; else nowhere else."""
    files = sorted(run.glob("*/transform.json"), key=lambda path: path.stat().st_mtime_ns)
    for path in reversed(files):
        placement = read_placement(path)
        if placement.map_number != 1:
            continue
        if placement.up is not None or not np.array_equal(placement.matrix, np.eye(4)):
            return placement, f"placed as in {path.parent.name}"
    return Placement(), "in the world of the trajectory"


def _coarse(run: Path, placement: Placement, num_frames: int) -> np.ndarray | None:
    """Poses (F, 4, 4) before, where the scene is; None where there were none."""
    path = run / "coarse.tum"
    if not path.exists():
        return None
    world_T_rigs = read_trajectory(path).world_T_rigs
    if len(world_T_rigs) != num_frames:
        logger.warning("%s is of other frames: it is not shown", path)
        return None
    return placement.similarity.poses(world_T_rigs)


def _placed_splat(name: str, gaussians: Gaussians, placement: Placement) -> Splat:
    """Gaussians moved to their place; colours are those of the constant harmonic."""
    if not len(gaussians):
        raise GsbaError(f"the splat {name!r} holds no Gaussians: train it again")
    unit = gaussians.quaternions / np.linalg.norm(gaussians.quaternions, axis=1, keepdims=True)
    move = placement.similarity
    axes = move.rotation @ rotation_from_quaternion(unit)
    factors = axes * (move.scale * np.exp(gaussians.log_scales.astype(np.float64)))[:, None]
    covariances = factors @ np.swapaxes(factors, 1, 2)
    return Splat(
        name,
        move.points(gaussians.means.astype(np.float64)).astype(np.float32),
        covariances.astype(np.float32),
        np.clip(0.5 + SH_CONSTANT * gaussians.sh[:, 0], 0, 1).astype(np.float32),
        (1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64))))[:, None].astype(
            np.float32
        ),
    )
