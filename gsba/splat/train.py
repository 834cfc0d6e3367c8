"""Training of a splat on posed faces: 3D Gaussian Splatting as published (Kerbl et al., 2023).

One view a step, in an order drawn anew for every round through the views; Adam; clone, split and
prune; opacity resets. The published schedule is for 30,000 steps and is scaled to the requested
number, down to sensible minima. Every random draw depends on the seed and the step alone, so that
an interrupted run resumes to the same result.
"""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.log import GsbaError, track
from gsba.splat import adam
from gsba.splat.backend import Backend, Lesson
from gsba.splat.camera import FaceCamera
from gsba.splat.density import Pull, densify, reset_opacity
from gsba.splat.gaussians import Gaussians, num_parameters
from gsba.splat.options import TrainingOptions
from gsba.store.records import load_checkpoint, save_record

logger = logging.getLogger(__name__)

# Values of Kerbl et al., 2023; lengths are relative to the extent of the cameras.
_SSIM_WEIGHT = 0.2  # of the loss; the rest is the absolute difference of colours
_RATE_ROTATIONS, _RATE_OPACITIES = 1e-3, 0.05  # learning rates
_RATE_COLORS = 2.5e-3  # learning rate of degree 0; a twentieth for higher degrees
_NEAR = 0.01  # near plane: nothing that a camera shows is closer
_CHECKPOINT_EVERY_S = 60.0  # so that an interruption costs a minute at most

Images = Sequence[np.ndarray] | np.ndarray  # of individual sizes, or of one size


@dataclass(frozen=True, slots=True)
class Views:
    """Posed images to train on."""

    cameras: Sequence[FaceCamera]  # (V,)
    images: Images  # (V,) of (H, W, 3) uint8, RGB
    use: Images | None  # (V,) of (H, W) bool, pixels of the loss; None = all
    panoramas: np.ndarray  # (V,) int, panorama that each is a part of

    @property
    def num_pixels(self) -> int:
        """Number of pixels of the loss."""
        if self.use is not None:
            return sum(int(np.count_nonzero(use)) for use in self.use)
        return sum(camera.width * camera.height for camera in self.cameras)


@dataclass(frozen=True, slots=True)
class TrainingState:
    """A splat in training."""

    step: int  # steps made
    gaussians: Gaussians
    moments: adam.Moments
    pull: Pull

    def copy(self) -> "TrainingState":
        """A state with arrays of its own: a step may change those of its state in place."""
        rows = np.arange(len(self.gaussians))
        pull = Pull(self.pull.sums.copy(), self.pull.counts.copy())
        return TrainingState(
            self.step, self.gaussians.select(rows), self.moments.select(rows), pull
        )


@dataclass(frozen=True, slots=True)
class Times:
    """The schedule of training, in steps."""

    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int  # opacities
    degree_every: int  # steps until one more degree of the harmonics


def times_for(iterations: int) -> Times:
    """The published schedule, scaled to a number of steps."""
    scale = iterations / 30_000  # steps of the published schedule
    return Times(
        densify_from=max(round(500 * scale), 100),
        densify_until=iterations // 2,
        densify_every=min(max(round(100 * scale), 50), 100),
        reset_every=max(round(3000 * scale), 3000),  # short trainings cannot recover from a reset
        degree_every=max(round(1000 * scale), 1),
    )


def train(
    start: Gaussians,
    views: Views,
    settings: TrainingOptions,
    backend: Backend,
    checkpoint: Path | None = None,
    key: str = "",
    watch: Callable[[int, Gaussians], object] | None = None,
) -> Gaussians:
    """Train a splat.

    Args:
        start: initial Gaussians, e.g. of `from_cloud`.
        checkpoint: file to store the training in and to resume from; None = none.
        key: digest of the inputs; a checkpoint with another key is not resumed.
        watch: called with the steps made and the splat, after each stretch of the backend's.

    Raises:
        GsbaError: all pixels are masked, there is no Gaussian, or parameters are no longer finite;
            the last checkpoint with finite ones is kept.
    """
    state = load_checkpoint(checkpoint, key, TrainingState, "training starts anew")
    if state is None:
        state = begin(start, settings)
    else:
        logger.info("resuming at step %d of %s", state.step, checkpoint)
    trainer = Trainer(views, settings, backend)
    saved = time.monotonic()
    steps = range(state.step, settings.iterations)
    for step in track(steps, "training the splat", total=len(steps)):
        if step < state.step:
            continue  # made together with an earlier one
        state = trainer.advance(state, settings.iterations)
        last = state.step == settings.iterations
        if state.step % 20 == 0 or last:
            _require_finite(state, checkpoint)
        if watch is not None:
            watch(state.step, state.gaussians)
        due = time.monotonic() - saved > _CHECKPOINT_EVERY_S
        if checkpoint is not None and (last or (due and state.gaussians.is_finite())):
            save_record(checkpoint, state, {"key": key})
            saved = time.monotonic()
    return state.gaussians


def begin(start: Gaussians, settings: TrainingOptions) -> TrainingState:
    """A training before its first step; if there are too many Gaussians, with a sample of them.

    Args:
        start: initial Gaussians, e.g. of `from_cloud`.
        settings: seed and limit on Gaussians; None = no limit.

    Raises:
        GsbaError: there is no Gaussian.
    """
    if len(start) == 0:
        raise GsbaError("no Gaussian to start from")
    rows = np.arange(len(start))
    if settings.max_gaussians is not None and len(start) > settings.max_gaussians:
        logger.warning("the cloud has %d points, %d are used", len(start), settings.max_gaussians)
        draw = np.random.default_rng(settings.seed)
        rows = np.sort(draw.permutation(len(start))[: settings.max_gaussians])
    first = start.select(rows)
    return TrainingState(0, first, adam.Moments.zero(first), Pull.none(len(first)))


def advance(
    state: TrainingState,
    views: Views,
    settings: TrainingOptions,
    backend: Backend,
    steps: int,
    densifying: bool = True,
) -> TrainingState:
    """Train for some steps; the given state is not changed.

    Args:
        densifying: False = the number of Gaussians stays.

    Raises:
        GsbaError: all pixels are masked, or parameters are no longer finite.
    """
    trainer, state = Trainer(views, settings, backend, densifying), state.copy()
    end = state.step + steps
    for step in track(range(state.step, end), "training the splat", total=steps):
        if step >= state.step:
            state = trainer.advance(state, end)
    _require_finite(state, None)
    return state


def _require_finite(state: TrainingState, checkpoint: Path | None) -> None:
    if not state.gaussians.is_finite():
        kept = "" if checkpoint is None else f"; the last good state is in {checkpoint}"
        raise GsbaError(f"the splat is no longer finite at step {state.step}{kept}")


def most_gaussians(views: Views, settings: TrainingOptions, backend: Backend) -> tuple[int, str]:
    """Limit on the number of Gaussians of a training, and its reason.

    The limit is that of the settings, if given. Otherwise Gaussians have at most as many parameters
    as pixels have values, as more would be undetermined between the views; and they fill at most
    half of the memory. An initial cloud with more is kept.
    """
    if settings.max_gaussians is not None:
        return settings.max_gaussians, "allowed"
    num = num_parameters(settings.sh_degree)
    pixels = views.num_pixels
    determined = max(3 * pixels // num, 1)
    # 8 copies: gradients, two moments, and those of density control
    held = max(backend.memory_bytes // 2 // (8 * np.dtype(np.float32).itemsize * num), 1)
    if determined <= held:
        return determined, f"that {pixels} pixels determine"
    return held, f"that half of {backend.memory_bytes / 1e9:.1f} GB of memory holds"


def extent_of(places: np.ndarray) -> float:
    """Radius of the region of cameras at (N, 3), times 1.1; 1 for a single place."""
    radius = float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())
    return 1.1 * radius if radius > 0 else 1.0


def near_of(world_T_rigs: np.ndarray) -> float:
    """Least z, map units, of a Gaussian rendered by rigs (N, 4, 4)."""
    return _NEAR * extent_of(world_T_rigs[:, :3, 3])


class Trainer:
    """Inputs that are constant over all steps. GsbaError: all pixels are masked."""

    def __init__(
        self, views: Views, settings: TrainingOptions, backend: Backend, densifying: bool = True
    ) -> None:
        if views.num_pixels == 0:
            raise GsbaError("no pixel to train a splat on: all frames are masked or held out")
        self.most, self.limit = most_gaussians(views, settings, backend)
        self.views, self.settings, self.backend = views, settings, backend
        self.densifying = densifying
        self.times = times_for(settings.iterations)
        self.extent = extent_of(np.array([camera.face_in_world for camera in views.cameras]))
        self.near = _NEAR * self.extent
        self.capped = False

    def advance(self, state: TrainingState, end: int) -> TrainingState:
        """Take a stretch of steps, at most to `end`; arrays of the state may be changed in
        place."""
        gaussians, moments, pull = state.gaussians, state.moments, state.pull
        times = self.times
        rhythms = (self.backend.stretch, times.densify_every, times.reset_every)
        stops = [end, *(state.step // every * every + every for every in rhythms)]
        step = min([*stops, times.densify_until] if state.step < times.densify_until else stops)
        lessons = (self._lesson(number) for number in range(state.step + 1, step + 1))
        wanted = self.densifying and step <= times.densify_until
        self.backend.descend(
            gaussians, moments, pull if wanted else None, lessons, self.near, _SSIM_WEIGHT
        )
        if wanted:
            if step > times.densify_from and step % times.densify_every == 0:
                draw = np.random.default_rng([self.settings.seed, step, 1])
                prunes_huge = step > times.reset_every
                given = gaussians, moments, pull, self.extent, self.most, prunes_huge, draw
                gaussians, moments, capped = densify(*given)
                if capped and not self.capped:
                    self.capped = True
                    logger.warning("%d Gaussians are the most %s", self.most, self.limit)
                pull = Pull.none(len(gaussians))
            if step % times.reset_every == 0 and step < times.densify_until:
                gaussians, moments = reset_opacity(gaussians, moments)
        return TrainingState(step, gaussians, moments, pull)

    def _lesson(self, number: int) -> Lesson:
        """The view and rates of a step, counted from 1."""
        turn, place = divmod(number - 1, len(self.views.cameras))
        draw = np.random.default_rng([self.settings.seed, turn])
        views, view = self.views, int(draw.permutation(len(self.views.cameras))[place])
        settings = self.settings
        done = number / settings.iterations
        means = settings.rate_means ** (1 - done) * settings.rate_means_end**done
        fade = settings.rate_fade**done
        return Lesson(
            views.cameras[view],
            views.images[view],
            None if views.use is None else views.use[view],
            min((number - 1) // self.times.degree_every, self.settings.sh_degree),
            adam.LearningRates(
                means=means * self.extent,
                log_scales=fade * settings.rate_scales,
                quaternions=fade * _RATE_ROTATIONS,
                opacity_logits=fade * _RATE_OPACITIES,
                sh=fade * _RATE_COLORS,
                sh_rest=fade * _RATE_COLORS / 20,
            ),
            number,
        )
