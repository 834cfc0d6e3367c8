"""Refinement of poses against a splat of their own frames, judged on held-out frames.

Splat and poses are refined in turn. The poses move by a few joint steps against the fixed splat,
the map's own observations, the patches if there are any, and the priors, which fix the gauge. Then
training goes on, once with the old poses and once with the moved ones, and evidence with known
noise judges the move:

- Faces of held-out panoramas, neither trained on nor aligned to the splat: the gain in PSNR of each
  of them. Both trainings have the same Gaussians, views and order. Density control rests, because
  cloning and pruning separate two trainings by tenths of a dB, while a twentieth of a pixel is
  worth hundredths.
- Points of the map: the fall of the cost of each one's observations. The poses may have been fitted
  to them before, so a change is ignored if fitting six numbers per pose gains as much by chance.

A move is accepted if both together are clearly in its favour; otherwise it is undone, and finer
faces follow.
"""

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from factors import LandmarkBlock
from gsba.bundle import adjustment, triangulation
from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.optimizer import OptimizeResult, optimize
from gsba.bundle.reconstruction import MIN_OBSERVATIONS, mean_colors
from gsba.camera.views import ONE_EYE, Optics
from gsba.frames.held_out import HOLD_OUT_EVERY
from gsba.splat.alignment import Captured, SplatGreys, capture, splat_block
from gsba.splat.backend import choose_backend
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.options import TrainingOptions
from gsba.splat.scene import Faces, Split, load_faces, make_views, split_frames
from gsba.splat.scores import face_psnrs
from gsba.splat.train import TrainingState, advance, begin, near_of
from gsba.store.records import load_checkpoint, save_record
from gsba.types import Counts, FrameSet, Keypoints, Landmarks, Round, Solution

_SH_DEGREE = 1  # of colours: low, so that views must agree on them
_FIRST_STEPS = 400  # training steps before poses move at each size
_STEPS = 150  # training steps after each move, before held-out panoramas compare the poses
_MAX_MOVES = 3  # most updates of the poses at each size
_MIN_SIGMAS = 2.0  # gain on held-out panoramas that a move needs, standard errors: chance alone
# reaches it once in forty moves; see docs/splats.md
_MAX_GROWTH = 1.05  # of the geometric cost, or a move is undone
_HELD_OUT_EVERY = HOLD_OUT_EVERY  # one panorama of so many judges the poses

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PoseMove:
    """One joint move of all poses, and its evidence from held-out frames."""

    size: int  # pixels of a face
    psnr_stayed: float  # dB, mean of held-out faces after fitting gains, old poses
    psnr_moved: float  # dB, mean of held-out faces, trained and measured with the moved poses
    psnr_sigma: float  # standard error of the difference of both, over faces
    growth: float  # cost of the map's own observations after the move, over that before
    growth_sigma: float  # its standard error, over points
    evidence: float  # for the move from both, in standard errors
    turned_deg: float  # median rotation of a pose
    shifted: float  # median translation of a pose, map units
    accepted: bool


@dataclass(frozen=True, slots=True)
class SplatResult:
    """Poses and points after the last accepted move."""

    adjustment: Solution
    counts: tuple[Counts, ...]  # of frames: those that the splat is trained on are kept
    moves: tuple[PoseMove, ...]

    @property
    def rounds(self) -> tuple[Round, ...]:
        """Rounds of the adjustment, including the moves."""
        return self.adjustment.rounds


@dataclass(frozen=True, slots=True)
class _Progress:
    """State from which an interrupted refinement resumes."""

    level: int  # index into the sizes
    turns: int  # moves made at this level; -1: before its first training
    world_T_rigs: np.ndarray  # (F, 4, 4)
    state: TrainingState
    moves: tuple[PoseMove, ...]
    rounds: tuple[Round, ...]


def refine(
    frames: FrameSet,
    keypoints: Keypoints,
    start: Solution,
    context: AdjustmentContext,
    checkpoint: Path | None = None,
    key: str = "",
    optics: Optics = ONE_EYE,
) -> SplatResult:
    """Refine a solved map against splats of its own frames, from coarse faces to fine; all faces
    are held in memory, one size at a time. Finished turns are stored in a checkpoint and resumed
    from it, if its key, a digest of the inputs, is this one. Raises GsbaError: all frames are
    masked, or the splat is no longer finite."""
    chosen = context.settings.splat
    usable = start.observations() >= MIN_OBSERVATIONS
    if np.count_nonzero(usable) <= _HELD_OUT_EVERY:
        few = int(np.count_nonzero(usable))
        logger.warning("%d refined frames are too few for a splat to judge poses by", few)
        return SplatResult(start, (Counts(len(frames), 0, "frames", {"too few": few}),), ())
    split = split_frames(usable, _HELD_OUT_EVERY)
    dropped = {"held out": len(split.held_out), "unrefined": int(np.count_nonzero(~usable))}
    counts = Counts(len(frames), len(split.training), "frames", dropped)
    turns = _Turns(keypoints, start, context, split)
    progress = load_checkpoint(checkpoint, key, _Progress, "the splat refinement starts anew")
    if progress is None:
        colors = mean_colors(start.landmarks.tracks, keypoints)
        cloud = from_cloud(start.landmarks.points_world, colors, _SH_DEGREE)
        first = begin(cloud, turns.training(0))
        progress = _Progress(0, -1, start.world_T_rigs, first, (), ())
    else:
        logger.info("resuming after %d moves of %s", len(progress.moves), checkpoint)
    while progress.level < len(chosen.sizes):
        turns.look(frames, progress.level, optics)
        while progress.turns < _MAX_MOVES:
            progress = turns.turn(progress)
            if checkpoint is not None:
                save_record(checkpoint, progress, {"key": key})
            if progress.turns > 0 and not progress.moves[-1].accepted:
                break
        progress = replace(progress, level=progress.level + 1, turns=-1)
    return SplatResult(turns.adjusted(progress), (counts,), progress.moves)


class _Turns:
    """Inputs that are constant over all turns, and the faces of one size."""

    def __init__(
        self, keypoints: Keypoints, solved: Solution, context: AdjustmentContext, split: Split
    ) -> None:
        self.keypoints, self.solved, self.context = keypoints, solved, context
        self.settings, self.split = context.settings, split
        self.backend = choose_backend(self.settings.splat.backend, context.num_threads)
        self.faces: Faces
        self.held_out: Faces
        self.captured: Captured

    def training(self, level: int) -> TrainingOptions:
        """Settings of the training that all turns share, at a level's size."""
        chosen = self.settings.splat
        each = _FIRST_STEPS + _MAX_MOVES * _STEPS
        return TrainingOptions(
            iterations=len(chosen.sizes) * each,
            face_size=chosen.sizes[level],
            sh_degree=_SH_DEGREE,
            max_gaussians=30_000,  # enough for faces of these sizes
            seed=self.settings.seed,
        )

    def look(self, frames: FrameSet, level: int, optics: Optics) -> None:
        """Cut the faces of a level."""
        size = self.settings.splat.sizes[level]
        self.faces = load_faces(frames, self.split.training, size, optics)
        self.held_out = load_faces(frames, self.split.held_out, size, optics)
        self.captured = capture(frames, self.split.training, size, optics)

    def turn(self, before: _Progress) -> _Progress:
        """The first training of a level, or a move of the poses and the training after it."""
        poses = before.world_T_rigs
        settings = self.training(before.level)
        if before.turns < 0:
            trained = self._trained(before.state, poses, settings, _FIRST_STEPS)
            return replace(before, turns=0, state=trained)
        moved, result = self._moved(before.state.gaussians, poses)
        stayed = self._trained(before.state, poses, settings, _STEPS, densifying=False)
        went = self._trained(before.state, moved, settings, _STEPS, densifying=False)
        looks = [
            self._held_out_psnrs(stayed, poses, settings),
            self._held_out_psnrs(went, moved, settings),
        ]
        costs = [self._point_costs(poses), self._point_costs(moved)]
        gains, savings = looks[1] - looks[0], costs[0] - costs[1]
        total, later = max(float(costs[0].sum()), 1e-12), float(costs[1].sum())
        tracks = self.solved.landmarks.tracks
        unknowns = 6 * len(np.unique(tracks.frames))
        redundancy = 2 * len(tracks) - 3 * tracks.num_points - unknowns
        growth = later / total
        chance = unknowns * min(total, later) / redundancy if redundancy > 0 else np.inf
        evidence = together(score(gains), score(savings, chance))
        after = self._placed(moved)
        accepted = evidence > _MIN_SIGMAS and growth <= _MAX_GROWTH
        accepted &= replace(self.solved, landmarks=after).carries(self.solved, MIN_OBSERVATIONS)
        turns = np.einsum("fji,fjk->fik", poses[:, :3, :3], moved[:, :3, :3])
        cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
        shifts = np.linalg.norm(moved[:, :3, 3] - poses[:, :3, 3], axis=1)
        angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
        move = PoseMove(
            settings.face_size, float(looks[0].mean()), float(looks[1].mean()),
            standard_error(gains), growth, len(savings) * standard_error(savings) / total,
            evidence, float(np.median(angles)), float(np.median(shifts)), accepted,
        )  # fmt: skip
        logger.info(
            "faces of %d px: held out %+.4f dB (standard error %.4f), cost of observations times "
            "%.4f (%.4f): evidence %+.1f, %s",
            move.size, move.psnr_moved - move.psnr_stayed, move.psnr_sigma, move.growth,
            move.growth_sigma, move.evidence, "accepted" if move.accepted else "undone",
        )  # fmt: skip
        note = Round(
            self._gate(), self.solved.noise, len(tracks), tracks.num_points, len(after.tracks),
            accepted, result.history, result.reason,
        )  # fmt: skip
        return _Progress(
            before.level,
            before.turns + 1,
            moved if accepted else poses,
            went if accepted else stayed,
            (*before.moves, move),
            (*before.rounds, note),
        )

    def adjusted(self, progress: _Progress) -> Solution:
        """The solution with the last accepted poses, points triangulated anew; or unchanged."""
        rounds = (*self.solved.rounds, *progress.rounds)
        if not any(move.accepted for move in progress.moves):
            return replace(self.solved, rounds=rounds)
        poses = progress.world_T_rigs
        return replace(
            self.solved, world_T_rigs=poses, landmarks=self._placed(poses), rounds=rounds
        )

    def _moved(
        self, gaussians: Gaussians, world_T_rigs: np.ndarray
    ) -> tuple[np.ndarray, OptimizeResult]:
        """Poses after a few joint steps, and the solver's result."""
        near = near_of(world_T_rigs[self.split.training])
        greys = SplatGreys(splat_block(gaussians, self.captured, near, self.backend))
        terms = self.context.beside(greys).terms(replace(self.solved, world_T_rigs=world_T_rigs))
        values, landmarks = terms.values, self._block()
        landmarks.polish(values)
        solver = replace(self.context.solver, max_iterations=2)
        result = optimize(terms.graph, values, [landmarks, *terms.blocks], solver)
        return adjustment.poses_of(result.values, len(world_T_rigs)), result

    def _block(self) -> LandmarkBlock:
        solved = self.solved
        return adjustment.landmark_block(
            solved.landmarks, self.keypoints, solved.noise, self.context
        )

    def _point_costs(self, world_T_rigs: np.ndarray) -> np.ndarray:
        """Robust cost (J,) of each point's observations, the point optimised under the poses."""
        block, values = self._block(), adjustment.values_of(world_T_rigs)
        block.polish(values)
        costs = np.zeros(len(block.points_world))
        for term, residuals in zip(block.terms, block.residuals(values)[0], strict=True):
            losses = block.loss.rho(np.einsum("oi,oi->o", residuals, residuals))
            costs += np.bincount(term.points, losses, len(costs))
        return costs

    def _trained(
        self,
        state: TrainingState,
        world_T_rigs: np.ndarray,
        settings: TrainingOptions,
        steps: int,
        densifying: bool = True,
    ) -> TrainingState:
        views = make_views(self.faces, world_T_rigs[self.split.training])
        return advance(state, views, settings, self.backend, steps, densifying)

    def _held_out_psnrs(
        self, state: TrainingState, world_T_rigs: np.ndarray, settings: TrainingOptions
    ) -> np.ndarray:
        """PSNR (V,) of each held-out face in dB, after fitting gains."""
        views = make_views(self.held_out, world_T_rigs[self.split.held_out])
        near = near_of(world_T_rigs[self.split.training])
        return face_psnrs(state.gaussians, views, settings, near, self.backend)

    def _placed(self, world_T_rigs: np.ndarray) -> Landmarks:
        """The map's points, triangulated under other poses."""
        return triangulation.place(
            self.solved.landmarks.tracks,
            self.keypoints,
            world_T_rigs,
            self._gate() * self.solved.noise,
            self.context.num_threads,
        )

    def _gate(self) -> float:
        rounds = self.solved.rounds
        return rounds[-1].gate_sigmas if rounds else np.inf


def standard_error(differences: np.ndarray) -> float:
    """Standard error of the mean of differences (N,); infinite for a single one."""
    num = len(differences)
    return float(differences.std(ddof=1) / np.sqrt(num)) if num > 1 else np.inf


def score(differences: np.ndarray, chance: float = 0.0) -> float:
    """Significance of a positive sum of differences (N,) beyond what chance explains, in standard
    errors. Few differences determine their spread poorly: their t is mapped to the normal score of
    equal probability (Wallace, Bounds on normal approximations, 1959)."""
    total, num = float(differences.sum()), len(differences)
    beyond, spread = max(abs(total) - chance, 0.0), num * standard_error(differences)
    if beyond == 0 or not np.isfinite(spread):
        return 0.0
    squared, free = (beyond / max(spread, 1e-12)) ** 2, num - 1
    size = np.sqrt(free * np.log1p(squared / free)) * (8 * free + 1) / (8 * free + 3)
    return float(np.copysign(size, total))


def together(*scores: float) -> float:
    """Combined score of several kinds of evidence: log likelihoods, half the squares, add up."""
    total = sum(one * abs(one) for one in scores)
    return float(np.copysign(np.sqrt(abs(total)), total))
