"""The camera's unknowns as variables of the graph, beside poses: found and measured together.

The lenses' centre and the readout's duration, which all frames share; each frame's motion while it
is read and, below a stabilised panorama, the way its lenses look. Points are eliminated, and what
frames have of their own is drawn to what is typical, by as much as frames turn out to differ.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from factors import Block
from factors.cholesky import DIM
from factors.quadratic_block import QuadraticBlock
from factors.reduced_camera_system import ReducedSystem
from gsba.bundle import lens_axes, prior_factors, readout, self_calibration
from gsba.bundle.adjustment import DRAWS, AdjustmentContext, values_of
from gsba.bundle.families import FamilyTerms
from gsba.bundle.lens_centres import by_inverse_stitch_radius
from gsba.bundle.optimizer import marginal_covariances
from gsba.bundle.readout import CameraEstimate
from gsba.bundle.shared_parameters import by_origin, weighted, without_points
from gsba.types import GyroConstraints, JointErrors, Keypoints, Solution

A = gtsam.symbol_shorthand.A  # turn (2,) rad of a frame's lenses, about x and y of their frame
B = gtsam.symbol_shorthand.B  # turn (3,) rad of the back lens of raw pairs in the rig
C = gtsam.symbol_shorthand.C  # the front lens's centre (3,), lenses' frame, map units
D = gtsam.symbol_shorthand.D  # duration (1,) of the readout, s
F = gtsam.symbol_shorthand.F  # relative focal length and principal point (3,) of a lens
K = gtsam.symbol_shorthand.K  # radial terms (4,) of a lens
N = gtsam.symbol_shorthand.N  # inverse of the stitching radius (1,), 1 / map units
W = gtsam.symbol_shorthand.W  # own motion (6,) of a frame, beside that of its velocity

_OF_LENSES = (F(0), 3), (K(0), 4), (F(1), 3), (K(1), 4), (B(0), 3)  # as `self_calibration` has them
_DAMPING = 1e-6
_SPREADS = 4  # passes over how widely frames' own motion is spread
_CONTRADICTED = 4.0  # squares of standard deviations that a gyro's rotations may be off, and
_EXPLAINED = 0.5  # part of what images show that it may leave over, where they are further off
_LEAST_TURN = 1e-6  # rad, standard deviation


@dataclass(frozen=True, slots=True)
class CameraCovariances:
    """Marginal covariances, camera and poses adjusted together."""

    poses: np.ndarray  # (F, 6, 6) float64, [rotation rad, translation], rig frame
    joint: JointErrors  # what the poses' errors have in common
    centre: np.ndarray  # (3, 3) float64, of the front lens
    readout_sigma: float  # s; NaN = no readout was taken
    inverse_stitch_radius_sigma: float  # 1 / map units; NaN = infinity, or as settings say
    lens_sigmas: np.ndarray | None = None  # (FREE,) of what lenses of raw pairs are; None = they
    # are as calibrated


@dataclass(frozen=True, slots=True)
class CameraSystem:
    """A map and its camera, to be adjusted together."""

    solved: Solution  # poses, points, noise
    keypoints: Keypoints  # of its observations, as rays of the camera so far
    shown: np.ndarray  # (N, 3) their directions in the pictures: these tell rows
    seeing: CameraEstimate  # the camera so far
    timestamps: np.ndarray  # (F,) seconds
    problem: AdjustmentContext  # priors, loss

    def step(self) -> CameraEstimate:
        """The camera that bearings ask for, poses and points adjusted with it.

        Frames turn while they are read as a gyro says, unless images have it otherwise.
        """
        turning = readout.turning_of(self.seeing.lenses, self.problem)
        if turning is None or self.seeing.lenses.readout_motion is None:
            return self._step()
        seeing = replace(self.seeing, by_gyro=self._agrees(turning))
        return replace(self, seeing=seeing)._step()

    def _step(self) -> CameraEstimate:
        camera, num = _linearized(self), len(self.solved.world_T_rigs)
        lenses, found = self.seeing.lenses, self.seeing
        variances = None
        for _ in range(1 if lenses.readout_motion is None else _SPREADS):
            system = camera.system(self.problem.graph)
            steps = system.solve(_DAMPING)
            if steps is None:
                return self.seeing
            if lenses.readout_motion is None:
                continue
            if variances is None:  # they hardly change with what is typical
                variances = _own_variances(camera, system)
            if variances is None:
                return self.seeing
            camera = _spread_anew(camera, system, steps, variances)

        def of(symbol: Callable[[int], int], count: int, dim: int) -> np.ndarray:
            return steps[[system.first_block[symbol(f)] for f in range(count)], :dim]

        lenses = replace(lenses, centre=lenses.centre + of(C, 1, 3)[0])
        if camera.values.exists(N(0)):
            inverse_radius = max(lenses.inverse_stitch_radius + float(of(N, 1, 1)[0, 0]), 0.0)
            lenses = replace(lenses, inverse_stitch_radius=inverse_radius)
        elif lenses.inverse_stitch_radius:
            baseline = float(np.linalg.norm(lenses.centre))
            inverse_radius = self.problem.settings.camera.inverse_stitch_radius(baseline)
            lenses = replace(lenses, inverse_stitch_radius=inverse_radius)
        if lenses.readout_motion is not None:
            motion = _velocities(self)
            longer, own = float(of(D, 1, 1)[0, 0]), of(W, num, 6)
            lenses = replace(lenses, readout_motion=lenses.readout_motion + longer * motion + own)
            duration, sigmas = self.seeing.readout_s + longer, camera.own[0].sigmas
            found = replace(found, readout_s=duration, own_sigmas=sigmas)
        if lenses.axes is not None:
            lenses = lens_axes.turned(lenses, of(A, num, 2))
        if lenses.fisheyes is not None:
            each = [steps[system.first_block[key], :dim] for key, dim in _OF_LENSES]
            lenses = self_calibration.moved(lenses, np.concatenate(each))
        return replace(found, lenses=lenses)

    def _agrees(self, turning: GyroConstraints) -> bool:
        """Whether frames turn while they are read as a gyro says, by images alone."""
        camera = _linearized(replace(self, seeing=replace(self.seeing, by_gyro=False)))
        system, own = camera.system(self.problem.graph), camera.own[0]
        steps, variances = system.solve(_DAMPING), _own_variances(camera, system)
        told = np.isfinite(turning.rates).all(axis=1)
        if steps is None or variances is None or not told.any():
            return False
        seen = (own.off + steps[_rows(own, system)])[told, :3]
        off = seen - self.seeing.readout_s * turning.rates[told]
        near = np.median(off**2 / variances[told, :3]) < _CONTRADICTED
        return bool(near or np.sum(off**2) < _EXPLAINED * np.sum(seen**2))

    def covariances(self, components: np.ndarray | None = None) -> CameraCovariances:
        """Marginal covariances with the first pose and the extent of each map held fixed.

        Args:
            components: (F,) map of each frame; None = there is one.
        """
        camera, num = _linearized(self), len(self.solved.world_T_rigs)
        poses, values = self.solved.world_T_rigs, camera.values
        graph = camera.graph(self.problem.held(poses, values, components))
        every = C(0), D(0), N(0), *(key for key, _ in _OF_LENSES)
        beside = [key for key in every if camera.values.exists(key)]
        seed, keys = self.problem.settings.seed, camera.keys[:num]
        found, joint = marginal_covariances(
            graph, camera.blocks(), values, keys, DRAWS, seed, beside
        )
        sigmas = {key: np.sqrt(np.diagonal(found[num + i])) for i, key in enumerate(beside)}
        nothing = np.array([np.nan])
        readout_sigma, of_nearness = (float(sigmas.get(key, nothing)[0]) for key in (D(0), N(0)))
        lenses = None
        if self.seeing.lenses.fisheyes is not None:
            lenses = np.concatenate([sigmas[key][:dim] for key, dim in _OF_LENSES])
        centre = found[num, :3, :3]
        return CameraCovariances(found[:num], joint, centre, readout_sigma, of_nearness, lenses)


@dataclass(frozen=True, slots=True)
class _Own:
    """Variables that each frame has of its own, at zero where they are now."""

    symbol: Callable[[int], int]
    off: np.ndarray  # (F, D) what they are from where they are drawn to
    sigmas: np.ndarray  # (D,) how strongly
    told: np.ndarray | None = None  # (F,) bool, those whose first three a gyro tells; None = none
    told_sigma: float = np.inf  # how strongly these

    def sigmas_of(self, frame: int) -> np.ndarray:
        """How strongly those of a frame are drawn (D,)."""
        if self.told is None or not self.told[frame]:
            return self.sigmas
        return np.concatenate([np.full(3, self.told_sigma), self.sigmas[3:]])


@dataclass(frozen=True, slots=True)
class _Camera:
    """Poses and camera as variables of a graph."""

    values: gtsam.Values  # the camera's are changes of what it is
    keys: list[int]  # those of frames' variables by kind, then shared ones
    hessian: csr_matrix  # of the bearings, six coordinates for each of keys
    gradient: np.ndarray
    cost: float
    curvature: float  # of the robust loss, see `SharedModel`
    own: tuple[_Own, ...]
    longer: tuple[float, float] | None  # s, what is said of the readout's change, and its sigma
    off: np.ndarray | None  # (FREE,) what lenses of raw pairs are from what they were calibrated as
    families: FamilyTerms  # of the caller, on poses and on variables of their own

    def graph(self, priors: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """What is believed of them beside the bearings."""
        graph = gtsam.NonlinearFactorGraph(priors)
        graph.push_back(self.families.graph)
        if self.longer is not None:
            model = gtsam.noiseModel.Diagonal.Sigmas(np.array([self.longer[1]]))
            graph.add(gtsam.PriorFactorVector(D(0), np.array([self.longer[0]]), model))
        if self.off is not None:
            spread = dict(_of_lenses(self_calibration.SPREAD))
            for key, off in _of_lenses(self.off):
                model = gtsam.noiseModel.Diagonal.Sigmas(spread[key])
                graph.add(gtsam.PriorFactorVector(key, -off, model))
        for own in self.own:
            for f, off in enumerate(own.off):
                model = gtsam.noiseModel.Diagonal.Sigmas(own.sigmas_of(f))
                graph.add(gtsam.PriorFactorVector(own.symbol(f), -off, model))
        return graph

    def blocks(self, stretch: float = 1.0) -> list[Block]:
        """The bearings' quadratic model, its curvature stretched, and the families' blocks."""
        bearings = QuadraticBlock(self.keys, stretch * self.hessian, self.gradient, self.cost)
        return [bearings, *self.families.blocks]

    def system(self, priors: gtsam.NonlinearFactorGraph) -> ReducedSystem:
        """Both, linearized."""
        system = ReducedSystem(self.graph(priors), self.blocks(self.curvature), self.values)
        system.linearize(self.values)
        return system


def _own_variances(camera: _Camera, system: ReducedSystem) -> np.ndarray | None:
    """Variances (F, 6) of frames' own motion; None where the system is singular."""
    inverse = system.covariances(0, np.random.default_rng(0), _DAMPING)
    if inverse is None:
        return None
    return np.einsum("fii->fi", inverse[0][_rows(camera.own[0], system)])


def _spread_anew(
    camera: _Camera, system: ReducedSystem, steps: np.ndarray, variances: np.ndarray
) -> _Camera:
    """The same with frames' own motion as widely spread as it turned out to be.

    By one step of expectation and maximisation: squares of the deviations plus their variances.
    """
    own = camera.own[0]
    squares = (own.off + steps[_rows(own, system)]) ** 2 + variances
    sigmas = np.sqrt(np.mean(squares, axis=0))
    if own.told is not None:  # what a gyro tells is no measure of the others
        sigmas[:3] = own.sigmas[:3]
    spread = replace(own, sigmas=sigmas)
    return replace(camera, own=(spread, *camera.own[1:]))


def _rows(own: _Own, system: ReducedSystem) -> list[int]:
    """Block of each frame's variable."""
    return [system.first_block[own.symbol(f)] for f in range(len(own.off))]


def _velocities(given: CameraSystem) -> np.ndarray:
    """How frames move, as far as poses and a gyro that is believed tell (F, 6)."""
    turning = given.problem.turning if given.seeing.by_gyro else None
    return readout.velocities(given.solved.world_T_rigs, given.timestamps, turning)


def _held(given: CameraSystem, own: _Own) -> _Own:
    """Frames' own motion, its rotation held to what a gyro that is believed tells."""
    turning = given.problem.turning
    if turning is None or not given.seeing.by_gyro:
        return own
    told = np.isfinite(turning.rates).all(axis=1)
    sigma = max(given.seeing.readout_s * turning.rate_sigma, _LEAST_TURN)
    return replace(own, told=told, told_sigma=sigma)


def _linearized(given: CameraSystem) -> _Camera:
    solved, seeing, lenses = given.solved, given.seeing, given.seeing.lenses
    num, tracks = len(solved.world_T_rigs), solved.landmarks.tracks
    seen = weighted(solved.landmarks, given.keypoints, solved, given.problem)
    frames, directions = tracks.frames, given.shown[seen.rows]
    rotations = solved.world_T_rigs[frames, :3, :3]
    bearings = given.keypoints.bearings_rig[seen.rows]
    by_start = by_origin(seen, rotations, bearings, lenses.inverse_stitch_radius)
    by_centre = lenses.by_centre(by_start, directions, frames)
    own, shared, by_frame = list[_Own](), list[tuple[int, np.ndarray]](), [seen.by_pose]
    if lenses.inverse_stitch_radius:
        by_near = by_inverse_stitch_radius(bearings, lenses.origins(directions, frames))
        if given.problem.settings.camera.stitch_radius_m is None:
            shared.append((N(0), by_near))
        else:  # metres: in map units it goes with the distance between the lenses
            per_centre = lenses.inverse_stitch_radius / np.sum(lenses.centre**2) * lenses.centre
            by_centre = by_centre - by_near * per_centre
    shared.insert(0, (C(0), by_centre))
    off = None
    if lenses.fisheyes is not None:
        off = self_calibration.from_calibrated(lenses)
        by_lenses = self_calibration.by_lenses(bearings, directions, lenses, seen.residuals)
        shared += _of_lenses(by_lenses)
    if lenses.readout_motion is not None:
        velocities = _velocities(given)
        times = lenses.fractions(directions, frames)[:, None, None]
        shared.append((D(0), times * (seen.by_pose @ velocities[frames, :, None])))
        beside = lenses.readout_motion - seeing.readout_s * velocities
        own.append(_held(given, _Own(W, beside, readout.own_sigmas(seeing, velocities))))
        by_frame.append(times * seen.by_pose)
    if lenses.axes is not None:
        own.append(_Own(A, np.zeros((num, 2)), np.full(2, lens_axes.TURNS[-1])))
        by_frame.append(by_centre @ lens_axes.by_turn(lenses))
    values = values_of(solved.world_T_rigs)
    keys = [prior_factors.X(f) for f in range(num)]
    for each in own:
        for f in range(num):
            values.insert(each.symbol(f), np.zeros(len(each.sigmas)))
            keys.append(each.symbol(f))
    for key, part in shared:
        values.insert(key, np.zeros(part.shape[2]))
        keys.append(key)
    system = without_points(
        seen, tracks, num, np.concatenate(by_frame, axis=2),
        np.concatenate([part for _, part in shared], axis=2),
    )  # fmt: skip
    places = _places(num, [part.shape[2] for part in by_frame], [p.shape[2] for _, p in shared])
    found, size = system.hessian.tocoo(), DIM * len(keys)
    at = tuple(places[coordinates] for coordinates in found.coords)
    hessian = csr_matrix((found.data, at), shape=(size, size))
    gradient = np.zeros(size)
    gradient[places] = system.gradient
    said, longer = given.problem.settings.camera.readout(), None
    if said is not None and values.exists(D(0)):
        longer = said[0] - seeing.readout_s, said[1]
    families = given.problem.families.terms(solved, given.problem.maps)
    values.insert(families.values)
    known = seen.curvature, tuple(own), longer, off, families
    return _Camera(values, keys, hessian, gradient, system.cost, *known)


def _of_lenses(columns: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """What is said (..., FREE) of raw lenses, by the variables that it is said of."""
    ends = np.cumsum([dim for _, dim in _OF_LENSES])[:-1]
    parts = np.split(columns, ends, axis=-1)
    return [(key, part) for (key, _), part in zip(_OF_LENSES, parts, strict=True)]


def _places(num_frames: int, own: list[int], shared: list[int]) -> np.ndarray:
    """Where each variable of a `LinearSystem` lies among variables of six coordinates each.

    Args:
        own: dimensions of each kind of variable that frames have.
        shared: those of each that all frames have.
    """
    starts = DIM * num_frames * np.arange(len(own))
    first = np.concatenate([start + np.arange(dim) for start, dim in zip(starts, own, strict=True)])
    of_frames = first + DIM * np.arange(num_frames)[:, None]
    after = DIM * (num_frames * len(own) + np.arange(len(shared)))
    beside = [start + np.arange(dim) for start, dim in zip(after, shared, strict=True)]
    return np.concatenate([of_frames.ravel(), *beside])
