"""Rounds of triangulation, bundle adjustment and filtering over one set of tracks."""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, Self, TypeVar

import gtsam
import numpy as np

from factors import Block, LandmarkBlock, RobustLoss, Term
from gsba.bundle import pose_variables, triangulation
from gsba.bundle.families import Families, Family, FamilyTerms
from gsba.bundle.observation_noise import observation_noise, with_scaled_noise
from gsba.bundle.optimizer import OptimizeResult, SolverOptions, marginal_covariances, optimize
from gsba.bundle.pose_variables import poses_of, values_of
from gsba.bundle.reconstruction import MIN_OBSERVATIONS
from gsba.bundle.tracks import runs
from gsba.bundle.trajectory_prior import GyroTurns
from gsba.camera.rig import CubeRig
from gsba.config import CameraSettings, RefineSettings
from gsba.memory import release_mapped_files
from gsba.types import (
    GyroConstraints,
    JointErrors,
    Keypoints,
    Landmarks,
    Round,
    Sighted,
    Solution,
    Tracks,
)


@dataclass(frozen=True, slots=True)
class DivisibleMap:
    """A map to be adjusted, whose residuals of landmarks are made a few at a time."""

    landmarks: Landmarks
    terms_of: Callable[[Landmarks], Sequence[Term]]  # terms of `factors` of some of the landmarks
    graph: gtsam.NonlinearFactorGraph  # of families
    values: gtsam.Values  # to start from: poses, and variables of families
    num_frames: int
    loss: RobustLoss  # of the observations

    @property
    def num_observations(self) -> int:
        """Number of observations."""
        return len(self.landmarks.tracks)

    def chunks(self) -> Iterator[tuple[np.ndarray, Sequence[Term]]]:
        """Landmarks (J, 3) and their terms, a few at a time."""
        landmarks = self.landmarks
        for points, _, own in runs(landmarks.tracks, 1 << 17):  # 20 MB
            some = Landmarks(landmarks.points_world[points], own, landmarks.counts)
            yield some.points_world, self.terms_of(some)
            release_mapped_files()


class Division(Protocol):
    """Adjusts maps in parts."""

    def minimized(self, map_: DivisibleMap, options: SolverOptions) -> OptimizeResult | None:
        """The result of `gsba.bundle.optimizer.optimize`; None = the map is not to be divided."""
        ...

    def covariances(
        self, map_: DivisibleMap, num_draws: int, seed: int
    ) -> tuple[np.ndarray, JointErrors] | None:
        """The result of `gsba.bundle.optimizer.marginal_covariances` for all poses; None = the map
        is not to be divided."""
        ...


ALIGNED_GATES = 6.0, 3.0  # gates of rounds with aligned patches, standard deviations
GATE_SCALE = 10.0  # gates wider than so many standard deviations widen the loss in proportion
_TOLERANCE = 3e-4  # relative decrease of the cost that ends a round, but the run's last one
_MIN_SUPPORT = 0.99  # share of the inliers that a round must keep, or it is undone
MIN_NOISE = 0.5  # floor of the estimated noise, in feature sigmas

logger = logging.getLogger(__name__)

_MIN_NOISE_RATIO = 1e-3  # least noise of an observation over its claimed sigma
DRAWS = 500  # errors drawn of all poses, from which joint covariances are computed
_DRIFT_DAMPING, _DRIFT_TOLERANCE = 1e-9, 1e-7  # first damping and relative tolerance of adjustments
# with a family that limits drift


@dataclass(frozen=True, slots=True)
class Terms:
    """Factors and blocks that an adjustment minimises, and its start values."""

    graph: gtsam.NonlinearFactorGraph
    blocks: tuple[Block, ...]
    values: gtsam.Values  # poses and families' own variables
    own: FamilyTerms  # the part of families
    observed: "ObservedPoints | None" = None  # landmarks seen along known rays, whose block is not
    # among `blocks`; None = there are none

    def minimized(self, options: SolverOptions) -> OptimizeResult:
        """The best values, in parts where the context divides the map; see `optimizer.optimize`."""
        blocks, observed = self.blocks, self.observed
        if observed is not None:
            division, map_ = observed.context.division, observed._divisible(self)
            found = division.minimized(map_, options) if division and map_ else None
            if found is not None:
                return found
            blocks = (observed.block(), *blocks)
        return optimize(self.graph, self.values, blocks, options)


@dataclass(frozen=True, slots=True)
class AdjustmentContext:
    """Families, settings and faces that all adjustments at one time of a run share."""

    families: Families  # of residuals: of points, trajectory prior, sensors, callers
    rig: CubeRig  # the faces
    settings: RefineSettings  # of rounds, threads, camera
    num_threads: int  # of the solver
    solver: SolverOptions = field(default_factory=SolverOptions)
    maps: np.ndarray | None = None  # (F,) map of each frame, for the families; None = there is one
    division: Division | None = None  # of large maps into parts; None = none is divided
    cameras: tuple[CameraSettings, ...] = ()  # (C,) of each camera; () = settings.camera of all
    scratch: Path | None = None  # folder on the disk that takes arrays of all observations; None =
    # they are in memory

    @property
    def turning(self) -> GyroConstraints | None:
        """The gyro's measurements of the frames; None where no gyro is used."""
        gyros = (family for family in self.families.members if isinstance(family, GyroTurns))
        return next((gyro.turning for gyro in gyros), None)

    def of_camera(self, camera: int) -> "AdjustmentContext":
        """The context with the settings of one camera."""
        if not self.cameras:
            return self
        own = {"camera": self.cameras[camera]}
        return replace(self, settings=self.settings.model_copy(update=own), cameras=())

    def beside(self, *families: Family) -> "AdjustmentContext":
        """The context with further families."""
        members = (*self.families.members, *families)
        return replace(self, families=self.families.with_members(members))

    def terms(self, solved: Solution) -> Terms:
        """Terms of all families for an adjustment that starts from a solution. GsbaError: a family
        whose factors are about variables without a value."""
        own = self.families.terms(solved, self.maps)
        return Terms(own.graph, own.blocks, values_of(solved.world_T_rigs, own.values), own)

    def covariance_terms(self, solved: Solution, maps: np.ndarray | None) -> Terms:
        """Terms for covariances: the first pose and the extent of each map are held fixed; maps:
        (F,) map of each frame, None = there is one."""
        own = self.families.covariance_terms(solved, self.maps)
        graph = gtsam.NonlinearFactorGraph(own.graph)
        graph.push_back(pose_variables.fixed_scale(solved.world_T_rigs, maps))
        return Terms(graph, own.blocks, values_of(solved.world_T_rigs, own.values), own)


@dataclass(frozen=True, slots=True)
class ObservedPoints:
    """Landmarks and the known rays that see them."""

    landmarks: Landmarks
    keypoints: Keypoints
    noise: float  # of the observations, in units of the keypoints' own sigmas
    context: AdjustmentContext

    def block(self) -> LandmarkBlock:
        """Their factor block."""
        return landmark_block(self.landmarks, self.keypoints, self.noise, self.context)

    def _terms_of(self, landmarks: Landmarks) -> list[Term]:
        return self.context.families.landmark_terms(landmarks, self.keypoints, self.noise)

    def _divisible(self, terms: Terms) -> DivisibleMap | None:
        """These and other terms as a map that may be divided; None = families have blocks."""
        if terms.blocks:
            return None
        return DivisibleMap(
            self.landmarks,
            self._terms_of,
            terms.graph,
            terms.values,
            len(self.keypoints.starts) - 1,
            self.context.solver.loss,
        )


class RaySource(Protocol):
    """Source of an adjustment's rays: known rays, or a camera that is solved for."""

    @property
    def keypoints(self) -> Keypoints:
        """The rays so far."""
        ...

    def with_noise_of(self, keypoints: Keypoints) -> Self:
        """The same, observations as noisy as keypoints of the same rows."""
        ...

    def terms(
        self, solved: Solution, noise: float, context: AdjustmentContext
    ) -> "tuple[Terms, Callable[[gtsam.Values], Self]]":
        """Terms that an adjustment from a solution minimises, and the view at the values it finds;
        noise: of the observations, in units of the keypoints' own sigmas."""
        ...


V = TypeVar("V", bound=RaySource)


@dataclass(frozen=True, slots=True)
class FixedRays:
    """Rays that are known."""

    keypoints: Keypoints

    def with_noise_of(self, keypoints: Keypoints) -> "FixedRays":
        """These, which are the same rays."""
        return FixedRays(keypoints)

    def terms(
        self, solved: Solution, noise: float, context: AdjustmentContext
    ) -> tuple[Terms, Callable[[gtsam.Values], "FixedRays"]]:
        """These points beside priors and families; rays stay."""
        observed = ObservedPoints(solved.landmarks, self.keypoints, noise, context)
        return replace(context.terms(solved), observed=observed), lambda _: self


def adjust_sighted(
    sighted: Sighted,
    before: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> tuple[Solution, Keypoints]:
    """As `adjust`, of aligned and former observations, the noise of either estimated on its own;
    and the keypoints with the noise that they turned out to have."""
    view = FixedRays(sighted.keypoints)
    solved, seen = adjust_sighted_through(view, sighted, before, context, gates, final)
    return solved, seen.keypoints


def adjust_sighted_through(
    view: V,
    sighted: Sighted,
    before: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> tuple[Solution, V]:
    """As `adjust_sighted`, through a camera that may be solved for, too."""
    solved, rounds = before, []
    for number, gate in enumerate(gates, 1):
        so_far = replace(sighted, keypoints=view.keypoints)
        there = rescale_noise(so_far, solved, context.settings, context.scratch)
        view, start = view.with_noise_of(there.keypoints), replace(solved, noise=1.0)
        solver = _options(context.solver, last=final and number == len(gates))
        looser = replace(context, solver=solver)
        solved, view = adjust_through(view, sighted.tracks, start, looser, (gate,))
        rounds += solved.rounds
    return replace(solved, rounds=tuple(rounds)), view


def rescale_noise(
    sighted: Sighted, before: Solution, settings: RefineSettings, scratch: Path | None = None
) -> Sighted:
    """Scale new and former observations' noise to what a solution shows of each.

    A patch's covariance knows the image's noise and texture, not how far a surface or a lens is
    from the model; residuals do. They also hold what the poses are off: too much noise, until
    poses are adjusted.
    """
    tracks, keypoints = sighted.tracks, sighted.keypoints
    poses = before.world_T_rigs
    threads = settings.solver.threads()
    # gate in sigmas for observations whose noise is not known yet
    placed = triangulation.place(tracks, keypoints, poses, 20.0, threads, scratch)
    factors = np.ones(len(keypoints.faces))
    for group in (sighted.aligned, ~sighted.aligned):
        chosen = group[keypoints.rows(placed.tracks)]
        if np.count_nonzero(chosen) >= MIN_OBSERVATIONS:
            noise = observation_noise(placed, keypoints, poses, threads, chosen)
            factors[group] = max(noise, _MIN_NOISE_RATIO)
    return replace(sighted, keypoints=with_scaled_noise(keypoints, factors, scratch))


def adjust(
    tracks: Tracks,
    keypoints: Keypoints,
    start: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> Solution:
    """Solve for all poses in rounds of tightening gates.

    The noise of observations is estimated anew after each round from what the unknowns leave over,
    so that gates and robust weights fit images of any quality. A round whose poses explain
    clearly fewer observations than those before it is undone.

    Args:
        tracks: candidate tracks; every round starts from all of them.
        start: poses to start from, and the noise known so far.
        gates: of each round, in standard deviations of the noise.
        final: whether the last round is solved to the end; others lose observations anyway.
    """
    return adjust_through(FixedRays(keypoints), tracks, start, context, gates, final)[0]


def adjust_through(
    view: V,
    tracks: Tracks,
    start: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> tuple[Solution, V]:
    """As `adjust`, through a camera that may be solved for beside the poses; and the view that
    belongs to the solution."""
    solved, rounds = replace(start, rounds=()), []
    place = _Placement(tracks, context)
    last_gate = gates[-1] * start.noise
    support = len(place(view.keypoints, solved.world_T_rigs, last_gate).tracks)
    for number, gate in enumerate(gates, 1):
        landmarks = place(view.keypoints, solved.world_T_rigs, gate * solved.noise)
        spread = solved.noise * max(1.0, gate / GATE_SCALE)
        solver = _options(context.solver, last=final and number == len(gates))
        if any(family.limits_drift for family in context.families.members):
            damping, tolerance = _DRIFT_DAMPING, _DRIFT_TOLERANCE
            solver = replace(solver, lambda_initial=damping, relative_tolerance=tolerance)
        here = replace(solved, landmarks=landmarks)
        terms, after = view.terms(here, spread, context)
        result = terms.minimized(solver)
        poses, then = poses_of(result.values, len(solved.world_T_rigs)), after(result.values)
        new_support = len(place(then.keypoints, poses, last_gate).tracks)
        accepted = new_support >= _MIN_SUPPORT * support
        if accepted:
            view, support = then, new_support
            variables = terms.own.variables(result.values)
            solved = replace(solved, world_T_rigs=poses, variables=variables)
            placed = place(view.keypoints, poses, gate * solved.noise)
            if len(placed.tracks):
                seen, threads = view.keypoints, context.num_threads
                noise = observation_noise(placed, seen, poses, threads)
                solved = replace(solved, noise=max(noise, MIN_NOISE))
        used = len(landmarks.tracks), landmarks.tracks.num_points
        outcome = accepted, result.history, result.reason
        rounds.append(Round(gate, solved.noise, *used, new_support, *outcome))
        logger.debug("round: %s", rounds[-1])
    placed = place(view.keypoints, solved.world_T_rigs, gates[-1] * solved.noise)
    return replace(solved, landmarks=placed, rounds=tuple(rounds)), view


class _Placement:
    """Points of tracks under poses: the last ones are kept, as they are asked for repeatedly."""

    def __init__(self, tracks: Tracks, context: AdjustmentContext) -> None:
        self._tracks, self._context = tracks, context
        self._asked: tuple[Keypoints, np.ndarray, float] | None = None
        self._found: Landmarks | None = None

    def __call__(self, keypoints: Keypoints, world_T_rigs: np.ndarray, gate: float) -> Landmarks:
        """Points within a gate, in the keypoints' own standard deviations."""
        if self._found is not None and self._asked is not None:
            seen, poses, before = self._asked
            if seen is keypoints and poses is world_T_rigs and before == gate:
                return self._found
        self._asked = keypoints, world_T_rigs, gate
        given = self._tracks, keypoints, world_T_rigs, gate, self._context.num_threads
        self._found = triangulation.place(*given, self._context.scratch)
        return self._found


def _options(options: SolverOptions, last: bool) -> SolverOptions:
    """Options of a round: only the last of a run is solved to the end."""
    if last or options.relative_tolerance > _TOLERANCE:
        return options
    return replace(options, relative_tolerance=_TOLERANCE, absolute_tolerance=None)


def landmark_block(
    landmarks: Landmarks, keypoints: Keypoints, noise: float, context: AdjustmentContext
) -> LandmarkBlock:
    """The factor block of the families that observe points; noise: of the observations, in units of
    the keypoints' own sigmas."""
    return LandmarkBlock(
        [pose_variables.X(f) for f in range(len(keypoints.starts) - 1)],
        landmarks.points_world,
        context.families.landmark_terms(landmarks, keypoints, noise),
        context.solver.loss,
        context.num_threads,
    )


def pose_covariances(
    solved: Solution,
    keypoints: Keypoints,
    context: AdjustmentContext,
    components: np.ndarray | None = None,
) -> tuple[np.ndarray, JointErrors]:
    """Marginal covariances (F, 6, 6) with the first pose and the extent of each map held fixed."""
    terms, seed = context.covariance_terms(solved, components), context.settings.seed
    observed = ObservedPoints(solved.landmarks, keypoints, solved.noise, context)
    division, map_ = context.division, observed._divisible(terms)
    found = division.covariances(map_, DRAWS, seed) if division and map_ else None
    if found is not None:
        return found
    keys = [pose_variables.X(f) for f in range(len(solved.world_T_rigs))]
    blocks = [observed.block(), *terms.blocks]
    return marginal_covariances(terms.graph, blocks, terms.values, keys, DRAWS, seed)
