"""Scene of a finished run: its poses, points, images and splats in one world."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.camera.views import ONE_EYE, Optics, View
from gsba.evaluate.scans import colors_of
from gsba.frames import cubemap
from gsba.frames.masks import load_mask
from gsba.frames.pixels import pictures_of
from gsba.geometry import rotation_from_quaternion
from gsba.log import GsbaError
from gsba.placement.world import Placement, read_placement
from gsba.report.html.figures import viewing_axes
from gsba.splat.gaussians import SH_CONSTANT, Gaussians, read_ply
from gsba.store.finished import load_cameras, load_run, map_digest, reported
from gsba.store.folder import STAGES
from gsba.trajectory.files import read_trajectory
from gsba.types import FACES, FrameSet, Reconstruction, RunStart

logger = logging.getLogger(__name__)

_MAX_FACE_PX = 768  # of a shown cube face
_SPLATS = "splat/*/point_cloud.ply"  # in a run's folder
_MASK_SHARE = 0.6  # of that colour in masked pixels


@dataclass(frozen=True, slots=True)
class Splat:
    """Gaussians for a viewer, with the constant spherical harmonic only."""

    name: str
    means: np.ndarray  # (N, 3) float32, world of the scene
    covariances: np.ndarray  # (N, 3, 3) float32, squared units of that world
    colors: np.ndarray  # (N, 3) float32, RGB, 0..1
    opacities: np.ndarray  # (N, 1) float32, 0..1


@dataclass(frozen=True, slots=True)
class RunScene:
    """Run with its splats and its comparison to a scan, in one world."""

    name: str
    frames: FrameSet
    reconstruction: Reconstruction  # refined poses and cloud
    coarse_T_rigs: np.ndarray | None  # (F, 4, 4) float64 initial poses; None = there were none
    splats: tuple[Splat, ...]
    up: np.ndarray  # (3,) float64, unit
    unit: str  # of the world: "map units", "m", ...
    grounds: str  # source of the world's placement, for the terminal
    step: float  # median distance of successive frames, > 0: size of drawn rigs
    optics: Optics = ONE_EYE  # of the frames, unit of the world
    start: str = RunStart.TRAJECTORY  # what the run started from
    judged: tuple[np.ndarray, np.ndarray] | None = None  # points (N, 3) and colours (N, 3) uint8
    # by their distance to a scan; None = not compared


def load_scene(run: Path) -> RunScene:
    """Scene of a finished run's largest map.

    Its world is that of the last export of this very map with a placement (upright, in metres, by
    GPS or truth), or else the run's own. Splats in RUN/splat are transformed to it. Raises
    GsbaError: the folder is no finished run, or a splat or transform.json cannot be read.
    """
    reconstruction, frames = load_run(run)
    placement, grounds = _latest_placement(run, map_digest(reconstruction, frames))
    placed = placement.apply(reconstruction)
    axes, _ = viewing_axes(placed.world_T_rigs)
    splats = (
        _placed_splat(path.parent.name, read_ply(path), placement)
        for path in sorted(run.glob(_SPLATS))
    )
    lenses = load_cameras(run, reconstruction, frames).scaled(placement.similarity.scale)
    steps = np.linalg.norm(np.diff(placed.world_T_rigs[:, :3, 3], axis=0), axis=1)
    moving = steps[steps > 1e-9 * (1 + steps.max(initial=0))]
    return RunScene(
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
        start=str(reported(run, "start") or RunStart.TRAJECTORY),
        judged=_judged(run, placed),
    )


def files_of_scene(run: Path) -> list[Path]:
    """The files of a run that its scene depends on."""
    patterns = f"{STAGES}/reconstruction.npz", "*/transform.json", _SPLATS, "scan.json"
    return sorted(path for pattern in patterns for path in run.glob(pattern))


def _judged(run: Path, placed: Reconstruction) -> tuple[np.ndarray, np.ndarray] | None:
    """Points and colours from `gsba evaluate --scan`; None if there are none for this cloud."""
    path = run / "scan.json"
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["points"]
        rows, distances = np.array(found["rows"], np.int64), np.array(found["distances"])
        if found["of"] != len(placed.points_world):
            logger.warning("%s is of an earlier run, and is not shown: evaluate again", path)
            return None
        return placed.points_world[rows], colors_of(distances, found["furthest"])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        raise GsbaError(f"{path}: cannot be read: evaluate with --scan again") from None


_UPS = {"-y": np.array([0.0, -1, 0]), "y": np.array([0.0, 1, 0]), "z": np.array([0.0, 0, 1])}


def faces_of(
    frames: FrameSet, f: int, masked: bool, optics: Optics = ONE_EYE
) -> dict[str, np.ndarray]:
    """Face images of a frame, uint8 RGB, by the names of the views of `views_of`.

    Args:
        frames: panoramas or cube faces; missing faces are left out.
        f: number of the frame.
        masked: tint masked pixels.
        optics: optics of the frames.

    Raises:
        GsbaError: images are missing or have changed since the run.
    """
    kind = frames.format_of(f)
    if optics:
        views = views_of(frames, f, optics)
        cutter = optics.cutter(views, f)
        images = list(cutter.cut(pictures_of(frames, f, cutter.focal)))
        mask = load_mask(frames, f) if masked else None
        if mask is not None:
            pairs = zip(images, cutter.cut_mask(mask), strict=True)
            images = [_tinted(image, use) for image, use in pairs]
        return {view.name: image for view, image in zip(views, images, strict=True)}
    rig = cubemap.native_rig(kind, _MAX_FACE_PX)
    images, use = cubemap.load(frames, f, rig)
    if masked and use is not None and frames.mask_paths[f] is not None:
        images = _tinted(images, use)
    names = kind.faces or FACES
    images = [images[FACES.index(name)] for name in names]
    if rig.size > _MAX_FACE_PX:
        size = _MAX_FACE_PX, _MAX_FACE_PX
        images = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
    return dict(zip(names, images, strict=True))


def views_of(frames: FrameSet, f: int, optics: Optics) -> tuple[View, ...]:
    """Views of the shown images of a frame."""
    return optics.views(min(frames.format_of(f).native_face_size, _MAX_FACE_PX))


def _tinted(image: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Images (..., 3) whose pixels outside of the mask `use` (...) bool are tinted."""
    red = _MASK_SHARE * np.array([192, 57, 43])
    tinted = np.round((1 - _MASK_SHARE) * image + red).astype(np.uint8)
    return np.where(use[..., None], image, tinted)


def _latest_placement(run: Path, digest: str) -> tuple[Placement, str]:
    """Placement of the latest export of map 1, as it is now, that has one, else the identity; and
    its source."""
    files = sorted(run.glob("*/transform.json"), key=lambda path: path.stat().st_mtime_ns)
    for path in reversed(files):
        placement = read_placement(path)
        if placement.map_number != 1:
            continue
        if placement.map_digest not in ("", digest):
            logger.warning("%s places an earlier map of the run: export again", path)
            continue
        if placement.up is not None or not np.array_equal(placement.matrix, np.eye(4)):
            return placement, f"placed as in {path.parent.name}"
    return Placement(), "in the run's own world"


def _coarse(run: Path, placement: Placement, num_frames: int) -> np.ndarray | None:
    """Initial poses (F, 4, 4) in the scene's world; None if there were none."""
    path = run / "coarse.tum"
    if not path.exists():
        return None
    world_T_rigs = read_trajectory(path).world_T_rigs
    if len(world_T_rigs) != num_frames:
        logger.warning("%s has another number of frames, and is not shown", path)
        return None
    return placement.similarity.poses(world_T_rigs)


def _placed_splat(name: str, gaussians: Gaussians, placement: Placement) -> Splat:
    """Splat in the placed world, with the colours of the constant harmonic."""
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
