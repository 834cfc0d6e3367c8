"""Direct photometric refinement: patches of all frames, joint with the map's observations."""

import logging
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import LandmarkBlock, RobustLoss
from factors.patches import PatchPixels, PatchTable, patch_spans
from factors.photometric import PhotometricBlock
from factors.sphere_image import SphereImage
from gsba import adjust, graph, patches
from gsba.adjust import Adjustment, Round
from gsba.config import PhotometricSettings, RefineSettings
from gsba.log import track
from gsba.optimize import OptimizeResult, optimize
from gsba.rig import CubeRig
from gsba.types import Counts, FrameSet, Keypoints

logger = logging.getLogger(__name__)

_LEAST_WEIGHT = 1e-3  # of a frame
_DEPTH_STEPS = 5  # Gauss-Newton steps on the planes at each level
_LEAST_PATCHES = 10  # observations of a frame that is judged


@dataclass(frozen=True, slots=True)
class PhotometricResult:
    """Poses and points after the joint solve, and what became of the patches."""

    adjustment: Adjustment
    counts: tuple[Counts, ...]  # of patches, then of observations, for each level
    frame_weights: np.ndarray  # (F,) float64, 1 = full trust in a frame's pixels
    residuals: np.ndarray  # (F,) float64, median over a frame of patches' residuals, sigmas


def run(
    frames: FrameSet,
    keypoints: Keypoints,
    start: Adjustment,
    priors: gtsam.NonlinearFactorGraph,
    rig: CubeRig,
    settings: RefineSettings,
    num_threads: int,
) -> PhotometricResult:
    """Refine a solved map by the grey values of patches, level after level.

    Args:
        frames: panoramas; read twice a level, one at a time.
        keypoints: of all frames.
        start: the solved map.
        priors: factors on the poses, gauge included.
        rig: the faces, for the reprojection family.
        settings: families, loss, solver, patches.
        num_threads: of the solver.
    """
    solved, counts = start, []
    weights, residuals = np.ones(len(frames)), np.full(len(frames), np.nan)
    for level in settings.photometric.levels:
        block, found = _patches(frames, solved, level, settings, num_threads)
        counts += found
        if not block.counted.any():
            logger.warning("no patch is seen twice at level %d: left as it was", level)
            continue
        landmarks = adjust.landmark_block(
            solved.landmarks, keypoints, rig, solved.noise, settings, num_threads
        )
        values = adjust.values_of(solved.world_T_rigs)
        result = optimize(priors, [landmarks, block], values, settings.solver)
        weights, residuals = _frame_weights(block, result.values, settings.photometric)
        if np.any(weights < 1):
            block.weigh(weights)
            result = optimize(priors, [landmarks, block], result.values, settings.solver)
        solved = _adjusted(solved, landmarks, result)
    return PhotometricResult(solved, tuple(counts), weights, residuals)


def _patches(
    frames: FrameSet, solved: Adjustment, level: int, settings: RefineSettings, num_threads: int
) -> tuple[PhotometricBlock, list[Counts]]:
    """The block of one level, its noise estimated, and what was kept for it."""
    chosen = settings.photometric
    top = level + chosen.depth_levels
    bearings, width = [], 0
    for f in track(range(len(frames)), "choosing patches"):
        greys, usable = patches.pyramid(frames, f, chosen, level)
        width = greys[-1].shape[1]
        bearings.append(patches.candidates(greys[-1], usable, chosen))
    table, counts = patches.table_of(
        bearings, solved.world_T_rigs, solved.landmarks, width, chosen
    )
    gathered, visible = _gather(frames, table, solved.world_T_rigs, level, top, chosen)
    values = adjust.values_of(solved.world_T_rigs)
    planes = table.planes
    for pixels in gathered[:0:-1]:  # coarse to fine
        block = make_block(pixels, visible, settings, num_threads)
        block.planes = planes
        block.refresh(values)
        block.polish(values, _DEPTH_STEPS)
        planes = block.planes
    block = make_block(gathered[0], visible, settings, num_threads)
    block.planes = planes
    block.refresh(values)
    block.polish(values, _DEPTH_STEPS)
    block.refresh(values)
    correlated = block.correlations(values) >= chosen.min_correlation
    kept = block.counted & correlated
    dropped = {
        "masked or saturated": int(np.count_nonzero(visible == 0)),
        **block.dropped,
        "does not correlate": int(np.count_nonzero(block.counted & ~correlated)),
    }
    seen = Counts(
        len(table.targets), int(np.count_nonzero(kept)), "patch observations", dropped
    )
    noise = _noise(block, values, kept) * chosen.inflation
    final = make_block(gathered[0], kept.astype(float), settings, num_threads, noise)
    final.planes = block.planes
    final.refresh(values)
    return final, [counts, seen]


def _gather(
    frames: FrameSet,
    table: PatchTable,
    world_T_rigs: np.ndarray,
    level: int,
    top: int,
    settings: PhotometricSettings,
) -> tuple[list[PatchPixels], np.ndarray]:
    """Pixels of the patches at the levels from `level` to `top`, and visibility (O,) 0 or 1."""
    gathered: list[PatchPixels] = []
    visible = np.ones(len(table.targets))
    for f in track(range(len(frames)), "sampling patches"):
        greys, usable = patches.pyramid(frames, f, settings, top)
        for k, grey in enumerate(greys[level:]):
            if k == len(gathered):
                scaled = replace(table, grid=2.0**k * table.grid)
                gathered.append(PatchPixels(scaled, world_T_rigs, grey.shape[1]))
            gathered[k].take(f, SphereImage.of(grey))
        rows = np.flatnonzero(table.targets == f)
        spans = patch_spans(table, world_T_rigs, table.planes, rows)
        visible[rows] = patches.usable_at(usable, spans[:, 0])
    return gathered, visible


def make_block(
    pixels: PatchPixels,
    weights: np.ndarray,
    settings: RefineSettings,
    num_threads: int,
    noise: float = 1.0,
) -> PhotometricBlock:
    """The factor block of gathered patches, `noise` times as uncertain as the settings say."""
    chosen = settings.photometric
    contrasts = pixels.templates.std(axis=1).astype(np.float64)
    sigmas = noise * np.hypot(chosen.noise_grey, chosen.noise_contrast * contrasts)
    return PhotometricBlock(
        [graph.X(f) for f in range(pixels.num_frames)],
        pixels,
        sigmas,
        RobustLoss("cauchy", chosen.loss_sigmas / chosen.inflation),
        weights,
        num_threads,
        chosen.polish_steps,
    )


def _noise(block: PhotometricBlock, values: gtsam.Values, kept: np.ndarray) -> float:
    """Typical residual of a pixel at the start, in units of the settings' sigma."""
    if not kept.any():
        return 1.0
    return float(np.sqrt(np.median(block.errors(values)[kept])))


def _frame_weights(
    block: PhotometricBlock, values: gtsam.Values, settings: PhotometricSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Weight (F,) of each frame's pixels, and the median (F,) of its residuals in sigmas.

    Blur, a passer-by or a wrong pose make a frame's patches fit worse than those of the others:
    beyond `max_frame_ratio` its weight falls with the square of the ratio.
    """
    kept = block.counted
    errors = np.sqrt(block.errors(values)[kept])
    frames = [block.table.targets[kept], block.table.hosts[block.table.owners][kept]]
    residuals = np.full(len(block.pose_keys), np.nan)
    for f in range(len(residuals)):
        rows = (frames[0] == f) | (frames[1] == f)
        if np.count_nonzero(rows) >= _LEAST_PATCHES:
            residuals[f] = np.median(errors[rows])
    typical = np.nanmedian(residuals) if np.isfinite(residuals).any() else 1.0
    ratios = np.nan_to_num(residuals / typical, nan=1.0)
    weights = np.where(
        ratios > settings.max_frame_ratio, (settings.max_frame_ratio / ratios) ** 2, 1.0
    )
    return np.maximum(weights, _LEAST_WEIGHT), residuals


def _adjusted(solved: Adjustment, landmarks: LandmarkBlock, result: OptimizeResult) -> Adjustment:
    world_T_rigs = adjust.poses_of(result.values, len(solved.world_T_rigs))
    placed = replace(solved.landmarks, points_world=landmarks.points_world)
    num = len(placed.tracks)
    gate = solved.rounds[-1].gate_sigmas if solved.rounds else np.inf
    note = Round(
        gate, solved.noise, num, placed.tracks.num_points, num, True, result.history, result.reason
    )
    return Adjustment(world_T_rigs, placed, solved.noise, (*solved.rounds, note))
