"""Observations of landmarks by a camera that is solved for: lenses, readout, axes beside poses."""

from collections.abc import Sequence

import gtsam
import numpy as np

from factors._camera_kernels import see_range
from factors._observations import covisible_pairs
from factors._terms import pose_rows
from factors.bearing import tangent_basis
from factors.block import PoseSystem
from factors.camera_rows import DIM, CameraRows, CameraVariables, Columns, Sightings
from factors.elimination import Eliminated
from factors.robust import RobustLoss
from factors.threads import balanced_ranges, map_in_threads

_POLISH_TOLERANCE = 1e-8  # of a landmark's cost: further steps gain less than the others do
_LEAST_HESSIAN = 1e-12  # of a landmark's trace
_FLATTEST = 0.3  # part of a robust loss's weights that its curvature is taken for, at least


class CameraBlock:
    """All observations of a set of landmarks by a camera whose parts are variables.

    Implements `factors.block.Block`. Landmarks are eliminated inside.

    Attributes:
        keys: of each frame its pose and what it has of its own, frame after frame; then what all
            frames share.
        pairs: (P, 2) int64, rows of keys that share a residual.
    """

    def __init__(
        self,
        camera: CameraVariables,
        sightings: Sightings,
        points_world: np.ndarray,
        loss: RobustLoss | None = None,
        num_threads: int = 1,
        polish_steps: int = 4,
    ) -> None:
        """Fix the pattern.

        Args:
            camera: variables, and what they act on.
            sightings: observations; see `sightings_of`.
            points_world: (J, 3) start values, world.
            loss: robust loss on each whitened residual norm; None is plain least squares.
            polish_steps: Gauss-Newton steps on the landmarks after each proposed step.
        """
        self.camera, self.loss = camera, loss or RobustLoss()
        self.num_threads, self.polish_steps = num_threads, polish_steps
        self.stretch = 1.0  # of the Hessian: see `curvature`
        self._sightings = sightings
        self._points = np.array(points_world, dtype=np.float64).reshape(-1, 3)
        self._trial: np.ndarray | None = None
        num, kinds = len(camera.poses), len(camera.of_frames)
        self.keys = [int(key) for frame in zip(*camera.of_frames, strict=True) for key in frame]
        self.keys += [int(key) for key, _ in camera.shared]
        self._starts, self._columns, _ = covisible_pairs(
            sightings.offsets, sightings.frames, num
        )
        rows = np.repeat(np.arange(num), np.diff(self._starts))
        self.pairs = _pairs(num, kinds, len(camera.shared), rows, self._columns)
        self._ranges = balanced_ranges(sightings.offsets)

    @property
    def points_world(self) -> np.ndarray:
        """(J, 3) float64, current landmarks."""
        return self._points.copy()

    def refresh(self, values: gtsam.Values) -> None:
        """Nothing depends on accepted values here."""

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Second-order model at `values`: robust weights, landmarks eliminated."""
        camera, poses = self.camera.rows(values), pose_rows(values, self.camera.poses)
        own, common = len(self.camera.own_places), len(self.camera.shared_places)
        sums, cost = Eliminated.zeros(self._starts, self._columns, own, common), 0.0

        def weighted(i: int) -> tuple[float, tuple[np.ndarray, ...]]:
            found = self._see(self._ranges[i], camera, poses, self._points, True)
            squares = np.einsum("oi,oi->o", found[0], found[0])
            roots = np.sqrt(self.loss.weights(squares))
            for part in found:
                part *= roots.reshape(-1, *[1] * (part.ndim - 1))
            return float(self.loss.rho(squares).sum()), found

        parts = map_in_threads(weighted, len(self._ranges), self.num_threads)
        for (first, last), (more, found) in zip(self._ranges, parts, strict=True):
            offsets = self._sightings.offsets[first : last + 1]
            frames = self._sightings.frames[offsets[0] : offsets[-1]]
            sums.add(offsets - offsets[0], frames, *found)
            cost += more
        return self._in_blocks(sums, cost)

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Robust cost at `values`, landmarks moved along."""
        self._trial, cost = self._polished(values, self.polish_steps, _POLISH_TOLERANCE)
        return cost

    def accept(self) -> None:
        """Keep the landmarks of the last proposal."""
        if self._trial is not None:
            self._points, self._trial = self._trial, None

    def polish(self, values: gtsam.Values, num_steps: int = 50) -> float:
        """Move the landmarks to their optimum at fixed values; returns the robust cost."""
        self._points, cost = self._polished(values, num_steps, 1e-12)
        return cost

    def residuals(self, values: gtsam.Values) -> np.ndarray:
        """Whitened residuals (O, 2) at the current landmarks, robust weights left out."""
        return self._seen(values, self._points)[0]

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Robust cost at the current landmarks."""
        return {"bearing": self._cost(self.residuals(values))}

    def curvature(self, values: gtsam.Values) -> float:
        """Curvature of the robust loss, part of its weights: steps by these fall as short."""
        squares = np.sum(self.residuals(values) ** 2, axis=1)
        weights = self.loss.weights(squares)
        step = 1e-4  # of a squared residual; the loss bends by its derivative
        bent = (self.loss.weights(squares * (1 + step)) - weights) / step
        return max(1 + float(bent.sum()) / max(float(weights.sum()), 1e-300), _FLATTEST)

    def jacobians(self, values: gtsam.Values) -> tuple[np.ndarray, ...]:
        """Whitened residuals (O, 2) and Jacobians (O, 2, ...) by the landmark (3), by coordinates
        of the frame's variables (K) and of the shared ones (S)."""
        camera, poses = self.camera.rows(values), pose_rows(values, self.camera.poses)
        return self._see((0, len(self._points)), camera, poses, self._points, True)

    def _see(
        self,
        landmarks: tuple[int, int],
        camera: CameraRows,
        poses: np.ndarray,
        points: np.ndarray,
        with_camera: bool,
    ) -> tuple[np.ndarray, ...]:
        """Residuals and Jacobians, as `jacobians`, of a run of landmarks."""
        first, last = self._sightings.offsets[list(landmarks)]
        num = last - first
        asked, own = num if with_camera else 0, len(self.camera.own_places)
        residuals, by_point = np.empty((num, 2)), np.empty((num, 2, 3))
        by_frame = np.zeros((asked, 2, own))
        by_shared = np.zeros((asked, 2, len(self.camera.shared_places)))
        see_range(
            first, last, self._sightings, camera, self.camera.columns, points, poses, residuals,
            by_point, by_frame, by_shared,
        )  # fmt: skip
        return residuals, by_point, by_frame, by_shared

    def _seen(self, values: gtsam.Values, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (O, 2) and Jacobians (O, 2, 3) by the landmarks."""
        camera, poses = self.camera.rows(values), pose_rows(values, self.camera.poses)

        def work(i: int) -> tuple[np.ndarray, ...]:
            return self._see(self._ranges[i], camera, poses, points, False)[:2]

        parts = map_in_threads(work, len(self._ranges), self.num_threads)
        residuals, by_point = zip(*parts, strict=True)
        return np.concatenate(residuals), np.concatenate(by_point)

    def _polished(
        self, values: gtsam.Values, num_steps: int, tolerance: float
    ) -> tuple[np.ndarray, float]:
        """Landmarks after damped Gauss-Newton steps that never raise their costs, and the cost."""
        points = self._points
        residuals, by_point = self._seen(values, points)
        costs, damping = self._point_costs(residuals), np.zeros(len(points))
        for _ in range(num_steps):
            steps, gains = self._point_steps(residuals, by_point, damping)
            open_ = gains > tolerance * costs
            if not open_.any():
                break
            trial = points + np.where(open_[:, None], steps, 0.0)
            at_trial, by_trial = self._seen(values, trial)
            after = self._point_costs(at_trial)
            better = open_ & (after < costs)
            points = np.where(better[:, None], trial, points)
            costs = np.where(better, after, costs)
            damping = np.where(better, 0.1 * damping, np.maximum(1e-3, 10 * damping))
            taken = better[self._sightings.points]
            residuals = np.where(taken[:, None], at_trial, residuals)
            by_point = np.where(taken[:, None, None], by_trial, by_point)
        return points, float(costs.sum())

    def _point_steps(
        self, residuals: np.ndarray, by_point: np.ndarray, damping: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Steps (J, 3) of landmarks, damped by their traces, and the decreases they promise."""
        weights = self.loss.weights(np.einsum("oi,oi->o", residuals, residuals))
        weighted = weights[:, None, None] * by_point
        hessians = self._summed(np.einsum("oij,oik->ojk", weighted, by_point))
        gradients = self._summed(np.einsum("oij,oi->oj", weighted, residuals))
        traces = np.einsum("jii->j", hessians)
        hessians += ((_LEAST_HESSIAN + damping) * traces + 1e-200)[:, None, None] * np.eye(3)
        steps = -np.linalg.solve(hessians, gradients[:, :, None])[:, :, 0]
        return steps, -0.5 * np.einsum("ji,ji->j", steps, gradients)

    def _summed(self, rows: np.ndarray) -> np.ndarray:
        """Sums of what observations (O, ...) say, by landmark (J, ...)."""
        out, offsets = np.zeros((len(self._points), *rows.shape[1:])), self._sightings.offsets
        seen = np.flatnonzero(np.diff(offsets))
        if len(seen):
            out[seen] = np.add.reduceat(rows, offsets[seen], axis=0)
        return out

    def _point_costs(self, residuals: np.ndarray) -> np.ndarray:
        return self._summed(self.loss.rho(np.einsum("oi,oi->o", residuals, residuals)))

    def _cost(self, residuals: np.ndarray) -> float:
        return float(self._point_costs(residuals).sum())

    def _in_blocks(self, sums: Eliminated, cost: float) -> PoseSystem:
        """The sums as 6x6 blocks of all keys."""
        own, common = self.camera.own_places, self.camera.shared_places
        num, kinds, shared = len(sums.gradient), len(self.camera.of_frames), len(self.camera.shared)
        among = _spread(sums.diagonal, own, own, kinds, kinds)
        across = _spread(sums.off_diagonal, own, own, kinds, kinds)
        down = _spread(sums.to_shared, own, common, kinds, shared)
        corner = _spread(sums.shared[None], common, common, shared, shared)[0]
        upper, above = np.triu_indices(kinds, 1), np.triu_indices(shared, 1)
        off = [
            among[:, upper[0], upper[1]].reshape(-1, DIM, DIM),
            across.reshape(-1, DIM, DIM),
            down.reshape(-1, DIM, DIM),
            corner[above],
        ]
        of_frames = among[:, np.arange(kinds), np.arange(kinds)].reshape(-1, DIM, DIM)
        of_all = corner[np.arange(shared), np.arange(shared)]
        gradient, rest = np.zeros((num, DIM * kinds)), np.zeros(DIM * shared)
        gradient[:, own], rest[common] = sums.gradient, sums.shared_gradient
        whole = np.concatenate([gradient.ravel(), rest]).reshape(-1, DIM)
        diagonal, off_diagonal = np.concatenate([of_frames, of_all]), np.concatenate(off)
        costs = {"bearing": cost}
        return PoseSystem(self.stretch * diagonal, self.stretch * off_diagonal, whole, costs)


def _pairs(num: int, kinds: int, shared: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Rows of keys that share a residual (P, 2), in the order of `CameraBlock._in_blocks`.

    Args:
        num: F.
        rows, columns: covisible frame pairs.
    """
    own, common = np.arange(kinds), kinds * num + np.arange(shared)
    upper, above = np.triu_indices(kinds, 1), np.triu_indices(shared, 1)
    first = kinds * np.arange(num)[:, None]
    among = np.stack([first + upper[0], first + upper[1]], axis=-1)
    across = np.stack(
        np.broadcast_arrays(
            kinds * rows[:, None, None] + own[:, None], kinds * columns[:, None, None] + own
        ),
        axis=-1,
    )
    down = np.stack(np.broadcast_arrays((first + own)[:, :, None], common), axis=-1)
    corner = np.stack([common[above[0]], common[above[1]]], axis=-1)
    parts = [part.reshape(-1, 2) for part in (among, across, down, corner)]
    return np.concatenate(parts).astype(np.int64)


def _spread(
    matrices: np.ndarray, rows: np.ndarray, columns: np.ndarray, high: int, wide: int
) -> np.ndarray:
    """Matrices (N, R, C) as blocks (N, high, wide, 6, 6), their rows and columns at places."""
    out = np.zeros((len(matrices), DIM * high, DIM * wide))
    out[:, rows[:, None], columns] = matrices
    return out.reshape(-1, high, DIM, wide, DIM).swapaxes(2, 3)


def sightings_of(
    frames: np.ndarray,
    points: np.ndarray,
    num_points: int,
    measured: np.ndarray,
    whiteners: np.ndarray,
    signs: np.ndarray,
    fractions: np.ndarray,
) -> tuple[Sightings, np.ndarray]:
    """Observations sorted by landmark and frame, and the row each was given in.

    Args: (O, ...) as in `Sightings`.
    """
    order = np.lexsort((frames, points))
    offsets = np.zeros(num_points + 1, np.int64)
    np.cumsum(np.bincount(points, minlength=num_points), out=offsets[1:])
    rows = (frames, points, measured, whiteners, signs, fractions)
    kinds: Sequence[type] = (np.int64, np.int64, float, float, float, float)
    sorted_ = [np.asarray(row)[order].astype(kind) for row, kind in zip(rows, kinds, strict=True)]
    return Sightings(offsets, *sorted_), order


def pixels_of(
    directions: np.ndarray, signs: np.ndarray, calibration: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (O, 3) that raw lenses show directions in, as `Sightings` has them, and how these
    move, on their tangent_basis, with the pixels (O, 2, 2).

    Args:
        directions: (O, 3) unit, rig frame.
        signs: (O,) of the lenses that see them, 1 = front, -1 = back.
        calibration: (2, 16) the lenses, as in `CameraRows`.
    """
    num = len(directions)
    frames, rows = np.zeros(num, np.int64), np.arange(num)
    plain = np.zeros((num, 3)), np.tile(np.eye(2), (num, 1, 1)), signs, np.zeros(num)
    sightings, _ = sightings_of(frames, rows, num, *plain)
    camera = CameraRows(
        np.zeros((1, 6)), np.zeros((1, 6)), np.eye(3)[None], np.zeros((1, 3, 2)), np.zeros(3), 0.0,
        np.zeros(3), np.ascontiguousarray(calibration), np.ones((2, 7)), np.eye(3),
    )  # fmt: skip
    pose, residuals = np.array([[*np.eye(3).ravel(), 0, 0, 0]]), np.empty((num, 2))
    by_direction, nothing = np.empty((num, 2, 3)), np.zeros((0, 2, 0))
    columns = Columns(-1, -1, -1, 3, -1)
    see_range(
        0, num, sightings, camera, columns, np.ascontiguousarray(directions), pose, residuals,
        by_direction, nothing, nothing,
    )  # fmt: skip
    along = by_direction @ np.swapaxes(tangent_basis(directions), 1, 2)
    return np.column_stack([residuals, np.zeros(num)]), np.linalg.inv(along)
