"""Bundle adjustment through a camera that is solved for: one graph of poses, points and camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np
from scipy.linalg import block_diag

from factors import Block
from factors.block import QuadraticBlock
from factors.camera_rows import LensVariables
from factors.direct_system import reduced_system
from factors.reduced_camera_system import ReducedSystem
from gsba.bundle import pose_variables, readout
from gsba.bundle.adjustment import (
    DRAWS,
    AdjustmentContext,
    FixedRays,
    Terms,
    V,
    adjust_sighted_through,
    adjust_through,
)
from gsba.bundle.camera_variables import CameraUnknowns, W
from gsba.bundle.optimizer import marginal_covariances
from gsba.bundle.readout import CameraEstimates
from gsba.bundle.stitching import with_noise_of
from gsba.types import JointErrors, Keypoints, Sighted, Solution, Tracks

_DAMPING = 1e-6


@dataclass(frozen=True, slots=True)
class CameraSigmas:
    """Marginal covariances of one camera."""

    centre: np.ndarray  # (3 (L - 1), 3 (L - 1)) float64, of the lenses' centres but the last one;
    # what is common to different lenses is left out
    readout_sigma: float  # s; NaN = no readout was taken
    inverse_stitch_radius_sigma: float  # 1 / map units; NaN = infinity, or as settings say
    lens_sigmas: np.ndarray | None = None  # (K,) of the parameters of raw lenses, see
    # `self_calibration`; None = they are as calibrated


@dataclass(frozen=True, slots=True)
class CameraCovariances:
    """Marginal covariances, cameras and poses adjusted together."""

    poses: np.ndarray  # (F, 6, 6) float64, [rotation rad, translation], rig frame
    joint: JointErrors  # what the poses' errors have in common
    cameras: tuple[CameraSigmas, ...]  # (C,)

    def grown(self, ratio: float) -> "CameraCovariances":
        """All covariances times a ratio, see `residual_correlation.variance_ratio`."""
        root = ratio**0.5
        joint = self.joint.scaled(np.full((len(self.poses), 6), root))
        cameras = [
            CameraSigmas(
                ratio * one.centre,
                root * one.readout_sigma,
                root * one.inverse_stitch_radius_sigma,
                None if one.lens_sigmas is None else root * one.lens_sigmas,
            )
            for one in self.cameras
        ]
        return CameraCovariances(ratio * self.poses, joint, tuple(cameras))


@dataclass(frozen=True, slots=True)
class CameraSystem:
    """A map and its cameras, linearized together."""

    solved: Solution  # poses, points, noise
    shown: Keypoints  # keypoints of its observations, as pictures show them
    cameras: CameraEstimates  # so far
    timestamps: np.ndarray  # (F,) seconds
    context: AdjustmentContext  # priors, loss

    def prepared(self) -> CameraEstimates:
        """The cameras with a decision on the gyro, and the estimated spread of frames' own motion.

        The spread is estimated by expectation maximisation: squared deviations plus variances.
        """
        read = [camera.lenses.readout_motion is not None for camera in self.cameras.each]
        if not any(read):
            return self.cameras
        cameras, num = self.cameras, len(self.solved.world_T_rigs)
        for number in np.flatnonzero(read).tolist():
            turning = readout.turning_of(cameras.each[number].lenses, self.context)
            if turning is not None:
                by_gyro = self._agrees(number, turning.rates)
                cameras = cameras.changed(number, replace(cameras.each[number], by_gyro=by_gyro))
        system = replace(self, cameras=cameras)._linearized()
        variances = system.own_variances()  # they hardly depend on the spread
        if variances is None:
            return cameras
        for _ in range(4):  # passes that estimate the spread of frames' own motion
            motion, own = system.own_motion(), system.unknowns.own
            if motion is None or own is None:
                break
            sigmas = list(own.sigmas)
            for number in np.flatnonzero(read).tolist():
                rows = cameras.frames_of(number, num)
                spread = np.sqrt(np.mean(motion[rows] ** 2 + variances[rows], axis=0))
                if own.told[rows].any():  # rotations by the gyro do not measure the spread of
                    # others
                    spread[:3] = sigmas[number][:3]
                sigmas[number] = spread
            system = replace(system, unknowns=system.unknowns.spread_as(sigmas))
        return system.unknowns.cameras

    def _agrees(self, number: int, rates: np.ndarray) -> bool:
        """True if images alone confirm a gyro's rates (F, 3) of a camera during the readout."""
        camera, num = self.cameras.each[number], len(rates)
        without = self.cameras.changed(number, replace(camera, by_gyro=False))
        alone = replace(self, cameras=without)._linearized()
        motion, variances = alone.own_motion(), alone.own_variances()
        own = np.isin(np.arange(num), self.cameras.frames_of(number, num))
        told = own & np.all(np.isfinite(rates), axis=1)
        if motion is None or variances is None or not told.any():
            return False
        seen = motion[told, :3]  # rotations are own motion alone: velocities of poses give none
        off = seen - camera.readout_s * rates[told]
        near = np.median(off**2 / variances[told, :3]) < 4.0  # variances of the motion
        return bool(near or np.sum(off**2) < 0.5 * np.sum(seen**2))

    def _unknowns(self) -> CameraUnknowns:
        poses = self.solved.world_T_rigs
        return CameraUnknowns.of(self.cameras, poses, self.timestamps, self.context)

    def _linearized(self) -> "_Linearized":
        """The quadratic model at these poses and this camera, points at their optimum."""
        unknowns, terms = self._unknowns(), self.context.terms(self.solved)
        terms.values.insert(unknowns.values)
        block = unknowns.block(self.solved.landmarks, self.shown, self.solved.noise, curved=True)
        block.polish(terms.values)
        whole = block.linearize(terms.values)
        blocks = (QuadraticBlock(block.keys, block.pairs, whole), *terms.blocks)
        return _Linearized(unknowns, terms.graph, blocks, terms.values)

    def covariances(self, components: np.ndarray | None = None) -> CameraCovariances:
        """Marginal covariances with the first pose and the extent of each map held fixed;
        components: (F,) map of each frame, None = there is one."""
        unknowns, terms = self._unknowns(), self.context.covariance_terms(self.solved, components)
        terms.values.insert(unknowns.values)
        block = unknowns.block(self.solved.landmarks, self.shown, self.solved.noise)
        block.polish(terms.values)
        num = len(self.solved.world_T_rigs)
        graph = gtsam.NonlinearFactorGraph(terms.graph)
        graph.push_back(unknowns.graph)
        beside = [key for key, _ in unknowns.variables.shared]
        found, joint = marginal_covariances(
            graph,
            [block, *terms.blocks],
            terms.values,
            list(unknowns.variables.poses),
            DRAWS,
            self.context.settings.seed,
            beside,
        )
        blocks = {
            key: block[:dim, :dim]
            for (key, dim), block in zip(unknowns.variables.shared, found[num:], strict=True)
        }
        cameras = [_sigmas_of(variables, blocks) for variables in unknowns.variables.cameras]
        return CameraCovariances(found[:num], joint, tuple(cameras))


def _sigmas_of(variables: LensVariables, covariances: dict[int, np.ndarray]) -> CameraSigmas:
    """Covariances of one camera, from those of all shared variables by their keys."""

    def sigmas(key: int | None) -> np.ndarray:
        """Standard deviations of a variable; NaN = there is none."""
        return np.full(1, np.nan) if key is None else np.sqrt(np.diagonal(covariances[key]))

    lenses, centre = None, np.zeros((0, 0))
    if variables.lenses is not None:
        lenses = np.concatenate([sigmas(key) for key in variables.lenses])
    if variables.centres:
        centre = np.asarray(block_diag(*(covariances[key] for key in variables.centres)))
    of_radius = float(sigmas(variables.radius)[0])
    return CameraSigmas(centre, float(sigmas(variables.readout)[0]), of_radius, lenses)


@dataclass(frozen=True, slots=True)
class _Linearized:
    """Quadratic model of bearings over poses and camera, and priors on these."""

    unknowns: CameraUnknowns
    graph: gtsam.NonlinearFactorGraph  # of all but the camera
    blocks: tuple[Block, ...]
    values: gtsam.Values

    def own_motion(self) -> np.ndarray | None:
        """Frames' own motion (F, 6) at the model's minimum; None where it is singular."""
        system, own = self._system(), self.unknowns.own
        steps = system.solve(_DAMPING)
        if steps is None or own is None:
            return None
        return own.values + steps[self._rows(system)]

    def own_variances(self) -> np.ndarray | None:
        """Variances (F, 6) of frames' own motion; None where the model is singular."""
        system = self._system()
        inverse = system.covariances(0, np.random.default_rng(0), _DAMPING)
        if inverse is None:
            return None
        return np.einsum("fii->fi", inverse[0][self._rows(system)])

    def _system(self) -> ReducedSystem:
        graph = gtsam.NonlinearFactorGraph(self.graph)
        graph.push_back(self.unknowns.priors())  # of frames that move by chance: their spread
        system = reduced_system(graph, self.blocks, self.values)
        system.linearize(self.values)
        return system

    def _rows(self, system: ReducedSystem) -> list[int]:
        """Block of each frame's own motion."""
        return [system.first_block[W(f)] for f in range(len(self.unknowns.variables.poses))]


_SCALE_SIGMA = 1e-3  # of each map's extent about its former one: images leave the scale open, and
# priors of zero on frames' own motion would shrink the map


@dataclass(frozen=True, slots=True)
class CameraView:
    """Observations through a camera that is solved for; an `adjustment.View`."""

    shown: Keypoints  # as pictures show them
    keypoints: Keypoints  # these keypoints as rays of the camera so far
    cameras: CameraEstimates
    timestamps: np.ndarray  # (F,) seconds

    @classmethod
    def of(cls, shown: Keypoints, cameras: CameraEstimates, timestamps: np.ndarray) -> "CameraView":
        """The view of keypoints, as pictures show them, through a known camera."""
        return cls(shown, cameras.cameras.seen(shown), cameras, timestamps)

    def with_noise_of(self, keypoints: Keypoints) -> "CameraView":
        """The view with the noise of other keypoints of the same rows."""
        shown = with_noise_of(self.shown, keypoints)
        return replace(self, shown=shown, keypoints=self.cameras.cameras.seen(shown))

    def terms(
        self, solved: Solution, noise: float, context: AdjustmentContext
    ) -> tuple[Terms, Callable[[gtsam.Values], "CameraView"]]:
        """Poses and camera as variables of one graph."""
        cameras = self.cameras
        if noise <= solved.noise:  # under wide gates next to nothing contradicts a gyro
            cameras = CameraSystem(solved, self.shown, cameras, self.timestamps, context).prepared()
        unknowns = CameraUnknowns.of(cameras, solved.world_T_rigs, self.timestamps, context)
        terms = context.terms(solved)
        terms.values.insert(unknowns.values)
        graph = gtsam.NonlinearFactorGraph(terms.graph)
        graph.push_back(unknowns.graph)
        poses, maps = solved.world_T_rigs, context.maps
        graph.push_back(pose_variables.fixed_scale(poses, maps, _SCALE_SIGMA))
        block = unknowns.block(solved.landmarks, self.shown, noise, curved=True)

        def after(values: gtsam.Values) -> "CameraView":
            found = unknowns.estimate(values)
            seen = found.cameras.seen(self.shown)
            return replace(self, keypoints=seen, cameras=found)

        return replace(terms, graph=graph, blocks=(block, *terms.blocks)), after


def solve_with_camera(
    tracks: Tracks,
    shown: Keypoints,
    cameras: CameraEstimates,
    timestamps: np.ndarray,
    start: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> tuple[Solution, CameraEstimates]:
    """Solve for poses, points and the parts of a camera that were taken, in one graph.

    The last round, of the tightest gate, is of poses and points alone. The keypoints are as
    pictures show them, timestamps (F,) in seconds; what the cameras leave out (a readout, axes, raw
    lenses) is left out. For start, context, gates and final see `adjustment.adjust`.
    """

    def adjusted(view: V, so_far: Solution, some: Sequence[float]) -> tuple[Solution, V]:
        return adjust_through(view, tracks, so_far, context, some, final)

    view = CameraView.of(shown, cameras, timestamps)
    solved, view, _ = _settled(start, view, gates, adjusted)
    return solved, view.cameras


def solve_sighted_with_camera(
    sighted: Sighted,
    cameras: CameraEstimates,
    timestamps: np.ndarray,
    before: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
) -> tuple[Solution, Keypoints, CameraEstimates]:
    """As `solve_with_camera`, of aligned and former observations as pictures show them, as
    `adjust_sighted` takes them; and the keypoints with the noise that they turned out to have."""

    def adjusted(view: V, so_far: Solution, some: Sequence[float]) -> tuple[Solution, V]:
        return adjust_sighted_through(view, sighted, so_far, context, some)

    view = CameraView.of(sighted.keypoints, cameras, timestamps)
    solved, view, rays = _settled(before, view, gates, adjusted)
    return solved, view.with_noise_of(rays).shown, view.cameras


class _Adjusted(Protocol):
    """Adjustment of some observations through a view, under some gates."""

    def __call__(self, view: V, so_far: Solution, some: Sequence[float]) -> tuple[Solution, V]: ...


_FEW_CHANGES = 1e-4  # share of the observations that may enter or leave at a gate once a camera is
# settled: a few at its edge do so in turn for ever


def _settled(
    start: Solution, view: CameraView, gates: Sequence[float], adjusted: _Adjusted
) -> tuple[Solution, CameraView, Keypoints]:
    """Solve for the camera under each gate until that takes in what it was solved with but for a
    few; the last round is of poses and points alone, and of the rays returned.

    Few observations, of near points that both lenses see, tell how far apart the lenses are. Under
    a wrong distance the gate leaves them out, and what is left confirms it. The tightest gate
    chooses observations by the camera so far, and these would confirm it: raw lenses came out worse
    by them.
    """
    solved, rounds = start, ()
    for gate in gates[:-1] or gates:
        for _ in range(8):  # of a round; three to six settle it
            solved, view = adjusted(view, solved, (gate,))
            rounds += solved.rounds
            last = solved.rounds[-1]
            entering = abs(last.support - last.observations)
            if not last.accepted or entering <= _FEW_CHANGES * last.observations:
                break
    solved, rays = adjusted(FixedRays(view.keypoints), solved, gates[-1:])
    return replace(solved, rounds=rounds + solved.rounds), view, rays.keypoints
