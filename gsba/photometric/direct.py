"""Direct photometric refinement: patches of all frames, joint with the map's observations."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors import Block, LandmarkBlock, RobustLoss
from factors.patch_windows import PatchPixels, PatchTable, patch_spans, poor_views
from factors.photometric import PhotometricBlock
from factors.sphere_image import SphereImage
from gsba.bundle import adjustment, pose_variables, triangulation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Family, MapSnapshot
from gsba.bundle.optimizer import OptimizeResult, optimize
from gsba.bundle.reconstruction import MIN_OBSERVATIONS
from gsba.camera.cameras import ONE_CAMERA, Cameras
from gsba.config import RefineSettings
from gsba.frames.masks import load_weights
from gsba.log import GsbaError, track
from gsba.photometric import patches
from gsba.types import Counts, FrameSet, Keypoints, Round, Solution


@dataclass(frozen=True, slots=True)
class PatchGreys(Family):
    """Grey values of patches of some frames in others. See `factors.photometric`."""

    name = "photometric"
    digest = ""  # stages keep their results by what the block is made of

    block: PhotometricBlock  # of sampled patches, whose planes stay as an adjustment leaves them

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """The block of all patches."""
        return (self.block,)


_DEPTH_LEVELS = 2  # halvings of the panorama on which depths are estimated first
_INFLATION = 2.0  # of sigmas: a patch's pixel errors are correlated
_MAX_GROWTH = 1.05  # of the geometric cost, or the solve is undone
_TOLERANCE = 1e-3  # relative decrease of the cost that ends the joint solve

logger = logging.getLogger(__name__)

_MIN_OBSERVATIONS = 10  # observations of a frame from which its fit is judged


@dataclass(frozen=True, slots=True)
class PhotometricResult:
    """Poses and points after the joint solve, and counts and residuals of the patches."""

    adjustment: Solution
    counts: tuple[Counts, ...]  # of patches, then of observations
    frame_weights: np.ndarray  # (F,) float64, weight of each frame's pixels, 1 = full
    residuals: np.ndarray  # (F,) float64, median of each frame's patch residuals, sigmas

    @property
    def rounds(self) -> tuple[Round, ...]:
        """Rounds of the adjustment."""
        return self.adjustment.rounds


def check(frames: FrameSet, settings: RefineSettings) -> None:
    """If the family is selected, refuse frames that patches cannot be sampled from. Raises
    GsbaError: cube faces, or panoramas of an odd height."""
    if len({(kind.width, kind.panoramic) for kind in frames.formats}) > 1 and (
        direct := settings.direct_families()
    ):
        raise GsbaError(
            f"the {' and '.join(sorted(direct))} family compares pictures of one size, these "
            "recordings have several: leave it out of --factors"
        )
    if "photometric" not in settings.factors:
        return
    for kind in frames.formats:
        if not kind.panoramic or kind.height % 2:
            what = f"{kind.height} rows" if kind.panoramic else "cube faces"
            raise GsbaError(
                f"the photometric family reads panoramas of even height, not {what}: leave it out "
                "of --factors"
            )


def refine(
    frames: FrameSet,
    keypoints: Keypoints,
    start: Solution,
    context: AdjustmentContext,
    lenses: Cameras = ONE_CAMERA,
) -> PhotometricResult:
    """Refine a solved map by the grey values of patches of panoramas, which are read twice, one at
    a time."""
    pixels, trust, counts = _patches(frames, start, context.num_threads, lenses)
    if pixels is None:
        logger.warning("no patch is observed twice: grey values refine nothing")
        nothing = np.ones(len(frames)), np.full(len(frames), np.nan)
        return PhotometricResult(start, tuple(counts), *nothing)
    solved, weights, residuals = _solve(pixels, trust, keypoints, start, context)
    return PhotometricResult(solved, tuple(counts), weights, residuals)


def _patches(
    frames: FrameSet, solved: Solution, num_threads: int, lenses: Cameras
) -> tuple[PatchPixels | None, np.ndarray, list[Counts]]:
    """Pixels of the patches and observations that are accepted, if any; weights; the counts."""
    world_T_rigs = solved.world_T_rigs
    bearings, width = [], 0
    for f in track(range(len(frames)), "choosing patches"):
        (grey,), usable = patches.pyramid(frames, f, 0)
        bearings.append(patches.candidates(grey, usable))
        width = grey.shape[1]
    landmarks = solved.landmarks
    table, counts = patches.table_of(bearings, world_T_rigs, landmarks, width, lenses)
    num, dropped = len(table.targets), {}
    left = np.ones(num, bool)
    poor = poor_views(table, world_T_rigs, table.planes)
    if lenses:
        shown = patch_spans(table, world_T_rigs, table.planes, np.arange(num))[:, 0]
        poor["between the lenses"] = lenses.blended(shown, table.targets)
    for reason, flag in poor.items():
        dropped[reason] = int(np.count_nonzero(flag & left))
        left &= ~flag
    table, _ = table.select(left)
    trust = np.zeros(len(table.targets))
    rows = np.cumsum(np.diff(table.offsets)) // 40_000  # at once: bounds the memory of windows
    for chunk in np.unique(rows):
        observations = (rows == chunk)[table.owners]
        part, own = table.select(observations)
        block = _with_depths(frames, part, world_T_rigs, num_threads, dropped)
        table.planes[own] = block.planes
        trust[observations] = block.weights
    kept = trust > 0
    seen = Counts(num, int(np.count_nonzero(kept)), "patch observations", dropped)
    table, _ = table.select(kept)
    gathered, _ = _gather(frames, table, world_T_rigs, 0)
    return next(iter(gathered), None), trust[kept], [counts, seen]


def _with_depths(
    frames: FrameSet,
    table: PatchTable,
    world_T_rigs: np.ndarray,
    num_threads: int,
    dropped: dict[str, int],
) -> PhotometricBlock:
    """Patches with planes estimated at fixed poses, coarse to fine; `dropped` counts others."""
    values = adjustment.values_of(world_T_rigs)
    gathered, visible = _gather(frames, table, world_T_rigs, _DEPTH_LEVELS)
    planes = table.planes
    for pixels in reversed(gathered):
        block = make_block(pixels, visible, num_threads)
        block.planes = planes
        block.refresh(values)
        block.polish(values, 5)  # Gauss-Newton steps on the planes at each level
        planes = block.planes
    block.refresh(values)
    correlated = block.correlations(values) >= 0.8  # with the template, at the start
    reasons = {
        "masked or saturated": np.count_nonzero(visible == 0),
        **block.dropped,
        "does not correlate": np.count_nonzero(block.counted & ~correlated),
    }
    for reason, number in reasons.items():
        dropped[reason] = dropped.get(reason, 0) + int(number)
    block.weigh_observations(correlated)
    block.refresh(values)
    return block


def _gather(
    frames: FrameSet, table: PatchTable, world_T_rigs: np.ndarray, top: int
) -> tuple[list[PatchPixels], np.ndarray]:
    """Pixels of patches at levels 0 to `top`; weights (O,) from the masks of both frames."""
    gathered: list[PatchPixels] = []
    visible, trusted = np.ones(len(table.targets)), np.ones(len(table))
    needed = np.union1d(table.hosts, table.targets)
    for f in track(needed.tolist(), "sampling patches"):
        greys, usable = patches.pyramid(frames, f, top)
        for k, grey in enumerate(greys):
            if k == len(gathered):
                scaled = replace(table, grid=2.0**k * table.grid)
                gathered.append(PatchPixels(scaled, world_T_rigs, grey.shape[1]))
            gathered[k].take(f, SphereImage.of(grey))
        rows = np.flatnonzero(table.targets == f)
        spans = patch_spans(table, world_T_rigs, table.planes, rows)
        visible[rows] = patches.values_at(usable, spans[:, 0])
        weights = load_weights(frames, f)
        if weights is not None:
            visible[rows] *= patches.values_at(weights, spans[:, 0])
            own = np.flatnonzero(table.hosts == f)
            trusted[own] = patches.values_at(weights, table.bearings_rig[own])
    return gathered, visible * trusted[table.owners]


def _solve(
    pixels: PatchPixels,
    trust: np.ndarray,
    keypoints: Keypoints,
    solved: Solution,
    context: AdjustmentContext,
) -> tuple[Solution, np.ndarray, np.ndarray]:
    """The joint solve, once more with lower weights of bad frames; undone if the map fits worse."""
    values = adjustment.values_of(solved.world_T_rigs)
    solver = replace(context.solver, relative_tolerance=_TOLERANCE, absolute_tolerance=None)
    weights = np.ones(pixels.num_frames)
    for _ in range(2):
        block = _weighted_block(pixels, trust, weights, values, context.num_threads)
        landmarks = adjustment.landmark_block(solved.landmarks, keypoints, solved.noise, context)
        landmarks.polish(values)
        before, fits = landmarks.error(values), _geometric_fits(landmarks, values)
        terms = context.beside(PatchGreys(block)).terms(solved)
        result = optimize(terms.graph, terms.values, [landmarks, *terms.blocks], solver)
        growth = _geometric_fits(landmarks, result.values) / fits
        doubts, residuals = _frame_weights(block, result.values, growth)
        if np.all(doubts >= 1) or np.any(weights < 1):
            break
        weights = doubts
    accepted = landmarks.error(result.values) <= _MAX_GROWTH * before
    after = replace(solved, variables=terms.own.variables(result.values))
    adjusted = _adjusted((solved, after), keypoints, result, accepted, context.num_threads)
    return adjusted, weights, residuals


def joint(
    frames: FrameSet,
    solved: Solution,
    frame_weights: np.ndarray,
    settings: RefineSettings,
    num_threads: int,
    lenses: Cameras = ONE_CAMERA,
) -> list[PatchGreys]:
    """The patches of a solved map, for a joint solve with another family; none if not selected;
    frame_weights (F,): of each frame's pixels, see `PhotometricResult`."""
    if "photometric" not in settings.factors:
        return []
    pixels, trust, _ = _patches(frames, solved, num_threads, lenses)
    if pixels is None:
        return []
    values = adjustment.values_of(solved.world_T_rigs)
    return [PatchGreys(_weighted_block(pixels, trust, frame_weights, values, num_threads))]


def make_block(
    pixels: PatchPixels, weights: np.ndarray, num_threads: int, noise: float = 1.0
) -> PhotometricBlock:
    """The factor block of gathered patches, with the settings' noise times `noise`."""
    contrasts = pixels.templates.std(axis=1).astype(np.float64)
    # noise of 2 grey values and a tenth of the contrast
    sigmas = noise * np.hypot(2.0, 0.1 * contrasts)  # grey values of a pixel
    return PhotometricBlock(
        [pose_variables.X(f) for f in range(pixels.num_frames)],
        pixels,
        sigmas,
        RobustLoss("cauchy", 2.0 / _INFLATION),  # Cauchy scale, of a patch's mean residual
        weights,
        num_threads,
    )


def _weighted_block(
    pixels: PatchPixels,
    trust: np.ndarray,
    frame_weights: np.ndarray,
    values: gtsam.Values,
    num_threads: int,
) -> PhotometricBlock:
    """The block of observations that count at the start, `values`, with the noise that they have
    there, and weights of frames (F,)."""
    start = make_block(pixels, trust, num_threads)
    start.refresh(values)
    noise, counted = 1.0, start.counted
    if counted.any():  # typical residual of a pixel in units of the settings' sigma
        noise = float(np.sqrt(np.median(start.errors(values)[counted])))
    block = make_block(pixels, counted * trust, num_threads, noise * _INFLATION)
    block.weigh(frame_weights)
    return block


def _geometric_fits(landmarks: LandmarkBlock, values: gtsam.Values) -> np.ndarray:
    """Median residual (F,) of each frame's geometric observations, sigmas; 1 without any."""
    residuals, _ = landmarks.residuals(values)
    norms = np.linalg.norm(np.concatenate(residuals), axis=1)
    frames = np.concatenate([term.frames for term in landmarks.terms])
    fits = np.ones(len(landmarks.keys))
    for f in range(len(fits)):
        rows = frames == f
        if np.count_nonzero(rows) >= _MIN_OBSERVATIONS:
            fits[f] = max(float(np.median(norms[rows])), 1e-9)
    return fits


def _frame_weights(
    block: PhotometricBlock, values: gtsam.Values, growth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weight (F,) of each frame's pixels, and the median (F,) of its residuals in sigmas.

    Blur, a passer-by or a wrong pose make a frame's patches fit worse than those of the others; or
    its pixels contradict its geometric observations, whose residuals grow by `growth (F,)`. Above
    the limit a weight falls with the square of the ratio.
    """
    kept = block.counted
    errors = np.sqrt(block.errors(values)[kept])
    targets, hosts = block.table.targets[kept], block.table.hosts[block.table.owners][kept]
    residuals = np.full(len(block.keys), np.nan)
    for f in range(len(residuals)):
        rows = (targets == f) | (hosts == f)
        if np.count_nonzero(rows) >= _MIN_OBSERVATIONS:
            residuals[f] = np.median(errors[rows])
    typical = np.nanmedian(residuals) if np.isfinite(residuals).any() else 1.0
    ratios = np.nan_to_num(residuals / typical, nan=1.0) / 2.0  # twice the median is allowed
    worst = np.maximum(1.0, np.maximum(ratios, growth / 1.2))
    return np.maximum(worst**-2.0, 1e-3), residuals  # least weight of a frame


def _adjusted(
    both: tuple[Solution, Solution],
    keypoints: Keypoints,
    result: OptimizeResult,
    accepted: bool,
    num_threads: int,
) -> Solution:
    """The solution with the joint solve's poses, or the old one if not accepted; `both`: the old
    one, and that with the variables of the joint solve.

    Points are triangulated again as after a bundle adjustment: those of the solve are closer to
    most observations than noise permits.
    """
    solved, moved = both
    tracks, least = solved.landmarks.tracks, MIN_OBSERVATIONS
    gate = solved.rounds[-1].gate_sigmas if solved.rounds else np.inf
    poses = adjustment.poses_of(result.values, len(solved.world_T_rigs))
    limit = gate * solved.noise
    placed = triangulation.place(tracks, keypoints, poses, limit, num_threads)
    after = replace(moved, world_T_rigs=poses, landmarks=placed)
    accepted &= after.carries(solved, least)
    support = len(placed.tracks)
    note = Round(
        gate, solved.noise, len(tracks), tracks.num_points, support, accepted, result.history,
        result.reason,
    )  # fmt: skip
    return replace(after if accepted else solved, rounds=(*solved.rounds, note))
