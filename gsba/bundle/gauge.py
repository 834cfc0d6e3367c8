"""The world and scale that families ask for: each map is moved by the similarity that fits their
residuals best, before an adjustment starts."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.sparse import csr_matrix

from gsba.bundle.families import Families, FamilyTerms, numbered
from gsba.bundle.pose_variables import X, values_of
from gsba.similarity import Sim3
from gsba.types import Solution

_MIN_CURVATURE = 1e-9  # least curvature that counts as determined, part of the largest


@dataclass(frozen=True, slots=True)
class Gauge:
    """The similarity that carries each map to its new world."""

    maps: np.ndarray  # (M,) int64, their numbers
    moves_by_map: tuple[Sim3, ...]  # (M)

    @property
    def moves(self) -> dict[int, Sim3]:
        """By the number of the map."""
        return dict(zip(self.maps.tolist(), self.moves_by_map, strict=True))

    def poses(self, world_T_rigs: np.ndarray, maps: np.ndarray | None) -> np.ndarray:
        """Poses (F, 4, 4) moved map by map; maps: (F,) map of each frame, None = there is one."""
        return _moved(world_T_rigs, numbered(maps, len(world_T_rigs)), self.moves)

    def scales(self, maps: np.ndarray | None, num_frames: int) -> np.ndarray:
        """Factors (F,) by which lengths beside each frame grow."""
        of_frames, moves = numbered(maps, num_frames), self.moves
        return np.array([moves[number].scale for number in of_frames.tolist()])

    def moved(self, solved: Solution, maps: np.ndarray | None) -> Solution:
        """A solution's poses moved map by map, without points and variables of families."""
        start = Solution.without_points(self.poses(solved.world_T_rigs, maps))
        return replace(start, noise=solved.noise, rounds=solved.rounds)


def align(families: Families, solved: Solution, maps: np.ndarray | None = None) -> Gauge:
    """The similarity that carries each map to where families that fix the gauge have it; maps: (F,)
    map of each frame, None = there is one.

    Levenberg-Marquardt over seven parameters a map and the families' own variables; what no
    residual determines (a world, where only the scale is known) stays.
    """
    chosen = families.fixing_gauge
    of_frames = numbered(maps, len(solved.world_T_rigs))
    numbers = np.unique(of_frames).tolist()
    moves = {number: Sim3() for number in numbers}
    terms = chosen.terms(solved, maps)
    poses, own, damping = solved.world_T_rigs, terms.values, 1e-4
    cost = _cost(terms, poses, own)
    for _ in range(100):  # of Levenberg-Marquardt
        hessian, gradient = _projected(terms, poses, own, of_frames, numbers)
        curvature = np.diagonal(hessian)
        floor = _MIN_CURVATURE * max(float(curvature.max(initial=0)), 1e-300)
        while damping < 1e8:
            damped = hessian + damping * np.diag(np.maximum(curvature, floor))
            step = -np.linalg.solve(damped + floor * np.eye(len(gradient)), gradient)
            of_maps = step[: 7 * len(numbers)].reshape(-1, 7)
            tried = dict(zip(numbers, map(_exp, of_maps), strict=True))
            new_poses = _moved(poses, of_frames, tried)
            delta, at, dims = gtsam.VectorValues(), 0, own.dims()
            for key in own.keys():  # noqa: SIM118
                delta.insert(key, step[of_maps.size :][at : at + dims[key]])
                at += dims[key]
            new_own = own.retract(delta)
            new_cost = _cost(terms, new_poses, new_own)
            if new_cost <= cost:
                break
            damping *= 10
        else:
            break
        moves = {number: tried[number].after(moves[number]) for number in numbers}
        poses, own, damping = new_poses, new_own, max(damping / 10, 1e-12)
        converged = cost - new_cost <= 1e-9 * cost  # relative decrease of the cost
        cost = new_cost
        if converged:
            break
    return Gauge(np.array(numbers, np.int64), tuple(moves.values()))


def _moved(world_T_rigs: np.ndarray, maps: np.ndarray, moves: dict[int, Sim3]) -> np.ndarray:
    poses = world_T_rigs.copy()
    for number, move in moves.items():
        poses[maps == number] = move.poses(world_T_rigs[maps == number])
    return poses


def _cost(terms: FamilyTerms, poses: np.ndarray, own: gtsam.Values) -> float:
    values = values_of(poses, own)
    cost = terms.graph.error(values)
    for block in terms.blocks:
        cost += sum(block.costs(values).values())
    return float(cost)


def _projected(
    terms: FamilyTerms, poses: np.ndarray, own: gtsam.Values, maps: np.ndarray, numbers: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations over [rotation, translation, log scale] of each map, and own variables.

    A pose's tangent is [R^T w, R^T (w x p + v + s p)] where its map turns by w, moves by v and
    grows by s about the origin.
    """
    values = values_of(poses, own)
    dims, own_keys = values.dims(), list(own.keys())
    size = 7 * len(numbers) + sum(dims[key] for key in own_keys)
    place, basis = 7 * len(numbers), dict[int, tuple[int, np.ndarray]]()
    for key in own_keys:
        basis[key] = place, np.eye(dims[key])
        place += dims[key]
    for f, (pose, number) in enumerate(zip(poses, maps.tolist(), strict=True)):
        back, p = pose[:3, :3].T, pose[:3, 3]
        by = np.zeros((6, 7))
        by[:3, :3] = back
        by[3:, :3] = back @ np.cross(np.eye(3), p).T  # w x p
        by[3:, 3:6] = back
        by[3:, 6] = back @ p
        basis[X(f)] = 7 * numbers.index(number), by
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    if terms.graph.size():
        _add_graph(terms.graph, values, dims, basis, hessian, gradient)
    for block in terms.blocks:
        block.refresh(values)
        system = block.linearize(values)
        places = [basis[key] for key in block.keys]
        parts = [(part[1].T, part[0], part[1].shape[1]) for part in places]
        for row, (turned, start, width) in enumerate(parts):
            here = slice(start, start + width)
            dim = turned.shape[1]
            gradient[here] += turned @ system.gradient[row, :dim]
            hessian[here, here] += turned @ system.diagonal[row, :dim, :dim] @ turned.T
        for (one, other), entry in zip(block.pairs.tolist(), system.off_diagonal, strict=True):
            (a, i, m), (b, j, n) = parts[one], parts[other]
            product = a @ entry[: a.shape[1], : b.shape[1]] @ b.T
            hessian[i : i + m, j : j + n] += product
            hessian[j : j + n, i : i + m] += product.T
    return hessian, gradient


def _add_graph(graph, values, dims, basis, hessian, gradient) -> None:
    """Add factors, linearized by GTSAM, to normal equations over the columns of `basis`."""
    keys = sorted(graph.keyVector())
    rows, columns, entries = graph.linearize(values).sparseJacobian_()
    num = sum(dims[key] for key in keys)
    shape = int(rows.max(initial=1)), num + 1
    augmented = csr_matrix((entries, (rows.astype(int) - 1, columns.astype(int) - 1)), shape=shape)
    onto = np.zeros((num, len(gradient)))
    at = 0
    for key in keys:
        start, by = basis[key]
        onto[at : at + dims[key], start : start + by.shape[1]] = by
        at += dims[key]
    jacobian = augmented[:, :num] @ onto
    hessian += jacobian.T @ jacobian
    gradient -= jacobian.T @ augmented[:, num].toarray().ravel()


def _exp(step: np.ndarray) -> Sim3:
    """The similarity of a step [rotation, translation, log scale]."""
    return Sim3(float(np.exp(step[6])), gtsam.Rot3.Expmap(step[:3]).matrix(), step[3:6])
