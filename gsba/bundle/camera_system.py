"""The camera's unknowns as variables of the graph, beside poses: found and measured together.

The lenses' centre and the readout's duration, which all frames share; each frame's motion while it
is read and, below a stabilised panorama, the way its lenses look. Points are eliminated, and what
frames have of their own is drawn to what is typical, by as much as frames turn out to differ.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.sparse import csr_matrix, hstack

from factors.quadratic_block import QuadraticBlock
from factors.reduced import ReducedSystem
from gsba.bundle import lens_axes, prior_factors, readout
from gsba.bundle.adjustment import DRAWS, Problem, values_of
from gsba.bundle.lens_centres import by_nearness
from gsba.bundle.optimizer import marginal_covariances
from gsba.bundle.readout import Readout
from gsba.bundle.shared_parameters import Normal, by_origin, sparse, weighted, without_points
from gsba.types import JointErrors, Keypoints, Solution

A = gtsam.symbol_shorthand.A  # turn (2,) rad of a frame's lenses, about x and y of their frame
C = gtsam.symbol_shorthand.C  # the front lens's centre (3,), lenses' frame, map units
D = gtsam.symbol_shorthand.D  # duration (1,) of the readout, s
N = gtsam.symbol_shorthand.N  # nearness (1,) that panoramas are stitched for, 1 / map units
W = gtsam.symbol_shorthand.W  # own motion (6,) of a frame, beside that of its velocity

_DAMPING = 1e-6
_SPREADS = 4  # passes over how widely frames' own motion is spread


@dataclass(frozen=True, slots=True)
class CameraCovariances:
    """Marginal covariances, camera and poses adjusted together."""

    poses: np.ndarray  # (F, 6, 6) float64, [rotation rad, translation], rig frame
    joint: JointErrors  # what the poses' errors have in common
    centre: np.ndarray  # (3, 3) float64, of the front lens
    readout_sigma: float  # s; NaN = no readout was taken
    nearness_sigma: float  # 1 / map units; NaN = stitched at infinity


@dataclass(frozen=True, slots=True)
class _Own:
    """Variables that each frame has of its own, at zero where they are now."""

    symbol: Callable[[int], int]
    off: np.ndarray  # (F, D) what they are from where they are drawn to
    sigmas: np.ndarray  # (D,) how strongly


@dataclass(frozen=True, slots=True)
class _Camera:
    """Poses and camera as variables of a graph."""

    values: gtsam.Values  # the camera's are changes of what it is
    keys: list[int]
    normal: Normal  # of the bearings, six coordinates for each of keys
    curvature: float  # of the robust loss, see `SharedModel`
    own: tuple[_Own, ...]
    longer: tuple[float, float] | None  # s, what is said of the readout's change, and its sigma

    def graph(self, priors: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
        """What is believed of them beside the bearings."""
        graph = gtsam.NonlinearFactorGraph(priors)
        if self.longer is not None:
            model = gtsam.noiseModel.Diagonal.Sigmas(np.array([self.longer[1]]))
            graph.add(gtsam.PriorFactorVector(D(0), np.array([self.longer[0]]), model))
        for own in self.own:
            model = gtsam.noiseModel.Diagonal.Sigmas(own.sigmas)
            for f, off in enumerate(own.off):
                graph.add(gtsam.PriorFactorVector(own.symbol(f), -off, model))
        return graph

    def block(self, stretch: float = 1.0) -> QuadraticBlock:
        """What bearings say of them, its curvature stretched."""
        normal = self.normal
        return QuadraticBlock(self.keys, stretch * normal.hessian, normal.gradient, normal.cost)


def step(
    solved: Solution,
    keypoints: Keypoints,
    shown: np.ndarray,
    seeing: Readout,
    timestamps: np.ndarray,
    problem: Problem,
) -> Readout:
    """The camera that bearings ask for, poses and points adjusted with it.

    Args:
        solved: poses, points, noise.
        keypoints: of its observations, as rays of the camera so far.
        shown: (N, 3) their directions in the pictures: these tell rows.
        seeing: the camera so far.
        timestamps: (F,) seconds.
        problem: priors, loss.
    """
    camera = _linearized(solved, keypoints, shown, seeing, timestamps, problem)
    num, lenses, found = len(solved.world_T_rigs), seeing.lenses, seeing
    for _ in range(1 if lenses.twists is None else _SPREADS):
        system = ReducedSystem(
            camera.graph(problem.priors), [camera.block(camera.curvature)], camera.values
        )
        system.linearize(camera.values)
        steps = system.solve(_DAMPING)
        if steps is None:
            return seeing
        if lenses.twists is not None:
            camera = _spread_anew(camera, system, steps)

    def of(symbol: Callable[[int], int], count: int, dim: int) -> np.ndarray:
        return steps[[system.first_block[symbol(f)] for f in range(count)], :dim]

    lenses = replace(lenses, centre=lenses.centre + of(C, 1, 3)[0])
    if lenses.nearness:
        lenses = replace(lenses, nearness=max(lenses.nearness + float(of(N, 1, 1)[0, 0]), 0.0))
    if lenses.twists is not None:
        motion = readout.velocities(solved.world_T_rigs, timestamps)
        longer, own = float(of(D, 1, 1)[0, 0]), of(W, num, 6)
        lenses = replace(lenses, twists=lenses.twists + longer * motion + own)
        duration, sigmas = seeing.readout_s + longer, camera.own[0].sigmas
        found = replace(seeing, readout_s=duration, own_sigmas=sigmas)
    if lenses.axes is not None:
        lenses = lens_axes.turned(lenses, of(A, num, 2))
    return replace(found, lenses=lenses)


def _spread_anew(camera: _Camera, system: ReducedSystem, steps: np.ndarray) -> _Camera:
    """The same with frames' own motion as widely spread as it turned out to be.

    By one step of expectation and maximisation: squares of the deviations plus their variances.
    """
    own = camera.own[0]
    rows = [system.first_block[own.symbol(f)] for f in range(len(own.off))]
    inverse = system.covariances(0, np.random.default_rng(0))
    if inverse is None:
        return camera
    squares = (own.off + steps[rows]) ** 2 + np.einsum("fii->fi", inverse[0][rows])
    spread = replace(own, sigmas=np.sqrt(np.mean(squares, axis=0)))
    return replace(camera, own=(spread, *camera.own[1:]))


def covariances(
    solved: Solution,
    keypoints: Keypoints,
    shown: np.ndarray,
    seeing: Readout,
    timestamps: np.ndarray,
    problem: Problem,
    components: np.ndarray | None = None,
) -> CameraCovariances:
    """Marginal covariances with the first pose and the extent of each map held fixed.

    Args: see `step`.
        components: (F,) map of each frame; None = there is one.
    """
    camera = _linearized(solved, keypoints, shown, seeing, timestamps, problem)
    graph, num = camera.graph(problem.priors), len(solved.world_T_rigs)
    graph.push_back(prior_factors.fixed_scale(solved.world_T_rigs, components))
    beside = [key for key in (C(0), D(0), N(0)) if camera.values.exists(key)]
    seed, poses = problem.settings.seed, camera.keys[:num]
    found, joint = marginal_covariances(
        graph, [camera.block()], camera.values, poses, DRAWS, seed, beside
    )
    sigmas = {key: float(np.sqrt(found[num + i, 0, 0])) for i, key in enumerate(beside)}
    shared = sigmas.get(D(0), np.nan), sigmas.get(N(0), np.nan)
    return CameraCovariances(found[:num], joint, found[num, :3, :3], *shared)


def _linearized(
    solved: Solution,
    keypoints: Keypoints,
    shown: np.ndarray,
    seeing: Readout,
    timestamps: np.ndarray,
    problem: Problem,
) -> _Camera:
    lenses, num = seeing.lenses, len(solved.world_T_rigs)
    tracks = solved.landmarks.tracks
    seen = weighted(solved.landmarks, keypoints, solved, problem)
    frames, directions = tracks.frames, shown[seen.rows]
    rotations, bearings = solved.world_T_rigs[frames, :3, :3], keypoints.bearings_rig[seen.rows]
    by_start = by_origin(seen, rotations, bearings, lenses.nearness)
    by_centre = lenses.by_centre(by_start, directions, frames)
    values, owned = values_of(solved.world_T_rigs), list[_Own]()
    keys, columns = [prior_factors.X(f) for f in range(num)], [(seen.by_pose, frames, num)]

    def shared(key: int, jacobians: np.ndarray) -> None:
        values.insert(key, np.zeros(jacobians.shape[2]))
        keys.append(key)
        columns.append((jacobians, np.zeros(len(frames), np.int64), 1))

    def own(
        symbol: Callable[[int], int], jacobians: np.ndarray, off: np.ndarray, sigmas: np.ndarray
    ) -> None:
        for f in range(num):
            values.insert(symbol(f), np.zeros(len(sigmas)))
            keys.append(symbol(f))
        owned.append(_Own(symbol, off, sigmas))
        columns.append((jacobians, frames, num))

    shared(C(0), by_centre)
    if lenses.nearness:
        shared(N(0), by_nearness(bearings, lenses.origins(directions, frames)))
    if lenses.twists is not None:
        velocities = readout.velocities(solved.world_T_rigs, timestamps)
        times = lenses.fractions(directions, frames)[:, None, None]
        shared(D(0), times * (seen.by_pose @ velocities[frames, :, None]))
        off = lenses.twists - seeing.readout_s * velocities
        own(W, times * seen.by_pose, off, readout.own_sigmas(seeing, velocities))
    if lenses.axes is not None:
        widths = np.full(2, lens_axes.TURNS[-1])
        own(A, by_centre @ lens_axes.by_turn(lenses), np.zeros((num, 2)), widths)
    whole = [_six(seen.roots @ part, rows, count) for part, rows, count in columns]
    normal = without_points(seen, tracks, csr_matrix(hstack(whole)))
    said, longer = problem.settings.camera.readout(), None
    if said is not None and values.exists(D(0)):
        longer = said[0] - seeing.readout_s, said[1]
    return _Camera(values, keys, normal, seen.curvature, tuple(owned), longer)


def _six(jacobians: np.ndarray, columns: np.ndarray, num: int) -> csr_matrix:
    """Jacobians (O, 2, D) by variables of D coordinates, of six with the last ones idle."""
    padded = np.zeros((len(jacobians), 2, 6))
    padded[:, :, : jacobians.shape[2]] = jacobians
    return sparse(padded, columns, num)
