"""Observations of landmarks by a camera that is solved for: lenses, readout, axes beside poses."""

from collections.abc import Sequence

import gtsam
import numpy as np

from factors._camera_kernels import polish_range, see_range
from factors._observations import covisible_pairs
from factors._terms import pose_rows
from factors.block import Block, PoseSystem
from factors.camera_rows import (
    DIM,
    CameraRows,
    CameraVariables,
    LensSightings,
)
from factors.elimination import Eliminated
from factors.robust import RobustLoss
from factors.threads import balanced_ranges, map_in_threads, run_in_threads


class CameraBlock(Block):
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
        sightings: LensSightings,
        points_world: np.ndarray,
        loss: RobustLoss | None = None,
        num_threads: int = 1,
        polish_steps: int = 3,
        curved: bool = False,
    ) -> None:
        """Fix the pattern; landmarks (J, 3), world, start here and take polish_steps Gauss-Newton
        steps after each proposed step. The loss is of each whitened residual norm; None is plain
        least squares. curved: scale the Hessian by the mean curvature of the loss, part of its
        weights: steps by these alone fall as short."""
        self.camera, self.loss = camera, loss or RobustLoss()
        self.num_threads, self.polish_steps = num_threads, polish_steps
        self.curved = curved
        self._sightings = sightings
        self._points = np.array(points_world, dtype=np.float64).reshape(-1, 3)
        self._point_costs = np.full(len(self._points), np.inf)
        self._trial: tuple[np.ndarray, np.ndarray] | None = None
        self._at: tuple[CameraRows, np.ndarray] | None = None  # where it was linearized
        num, kinds = len(camera.poses), len(camera.of_frames)
        self.keys = [int(key) for frame in zip(*camera.of_frames, strict=True) for key in frame]
        self.keys += [int(key) for key, _ in camera.shared]
        self._starts, self._columns, _ = covisible_pairs(sightings.offsets, sightings.frames, num)
        rows = np.repeat(np.arange(num), np.diff(self._starts))
        shared = len(camera.shared)
        own, common = np.arange(kinds), kinds * num + np.arange(shared)
        upper, above = np.triu_indices(kinds, 1), np.triu_indices(shared, 1)
        first = kinds * np.arange(num)[:, None]
        among = np.stack([first + upper[0], first + upper[1]], axis=-1)
        across = np.stack(
            np.broadcast_arrays(
                kinds * rows[:, None, None] + own[:, None],
                kinds * self._columns[:, None, None] + own,
            ),
            axis=-1,
        )
        down = np.stack(np.broadcast_arrays((first + own)[:, :, None], common), axis=-1)
        corner = np.stack([common[above[0]], common[above[1]]], axis=-1)
        parts = [part.reshape(-1, 2) for part in (among, across, down, corner)]
        self.pairs = np.concatenate(parts).astype(np.int64)
        self._ranges = balanced_ranges(sightings.offsets)

    @property
    def points_world(self) -> np.ndarray:
        """(J, 3) float64, current landmarks."""
        return self._points.copy()

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Second-order model at `values`: robust weights, landmarks eliminated."""
        self._at = self.camera.rows(values), pose_rows(values, self.camera.poses)
        own, common = len(self.camera.own_places), len(self.camera.shared_places)
        sums, at = Eliminated.zeros(self._starts, self._columns, own, common), self._at

        weights, bent = 0.0, 0.0

        def weighted(i: int) -> tuple[np.ndarray, ...]:
            found = self._see(self._ranges[i], *at)
            squares = np.sum(found[0] ** 2, axis=1)
            roots = np.sqrt(self.loss.weights(squares))
            for part in found:
                part *= roots.reshape(-1, *[1] * (part.ndim - 1))
            return squares, *found

        parts = map_in_threads(weighted, len(self._ranges), self.num_threads)
        for (first, last), (squares, *found) in zip(self._ranges, parts, strict=True):
            offsets = self._sightings.offsets[first : last + 1]
            rows = slice(offsets[0], offsets[-1])
            sums.add(offsets - offsets[0], self._sightings.frames[rows], *found)
            owners = self._sightings.points[rows] - first
            losses, curvatures = self.loss.rho(squares), self.loss.curvatures(squares)
            self._point_costs[first:last] = np.bincount(owners, losses, last - first)
            weights += float(self.loss.weights(squares).sum())
            bent += float(curvatures.sum())
        stretch = max(bent / max(weights, 1e-300), 0.3) if self.curved else 1.0
        return self._in_blocks(sums, stretch, float(self._point_costs.sum()))

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Robust cost at `values`, `steps` from the linearization, landmarks moved along."""
        if self._at is None:
            raise RuntimeError("propose() needs linearize() before it")
        self._trial = self._moved(values, steps, self.polish_steps, 1e-6)
        return float(self._trial[1].sum())

    def accept(self) -> None:
        """Keep the landmarks of the last proposal."""
        if self._trial is not None:
            (self._points, self._point_costs), self._trial = self._trial, None

    def polish(self, values: gtsam.Values, num_steps: int = 50) -> float:
        """Move the landmarks to their optimum at fixed values; returns the robust cost."""
        self._points, self._point_costs = self._moved(values, None, num_steps, 1e-12)
        return float(self._point_costs.sum())

    def jacobians(self, values: gtsam.Values) -> tuple[np.ndarray, ...]:
        """Whitened residuals (O, 2) and Jacobians (O, 2, ...) by the landmark (3), by coordinates
        of the frame's variables (K) and of the shared ones (S)."""
        camera, poses = self.camera.rows(values), pose_rows(values, self.camera.poses)
        return self._see((0, len(self._points)), camera, poses)

    def residuals(self, values: gtsam.Values) -> np.ndarray:
        """Whitened residuals (O, 2) at the current landmarks, robust weights left out."""
        return self.jacobians(values)[0]

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Robust cost at the current landmarks."""
        return {"bearing": float(self._moved(values, None, 0, 0.0)[1].sum())}

    def _see(
        self, landmarks: tuple[int, int], camera: CameraRows, poses: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Residuals and Jacobians, as `jacobians`, of a run of landmarks."""
        first, last = self._sightings.offsets[list(landmarks)]
        num, own = last - first, len(self.camera.own_places)
        residuals, by_point = np.empty((num, 2)), np.empty((num, 2, 3))
        by_frame = np.empty((num, 2, own))
        by_shared = np.empty((num, 2, len(self.camera.shared_places)))
        see_range(
            first, last, self._sightings, camera, self.camera.columns, self._points, poses,
            residuals, by_point, by_frame, by_shared,
        )  # fmt: skip
        return residuals, by_point, by_frame, by_shared

    def _moved(
        self, values: gtsam.Values, steps: np.ndarray | None, num_steps: int, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks (J, 3) at their best with `values`, and their costs (J,); the tolerance is
        part of a landmark's cost: a step that gains less is the last one."""
        camera, poses = self.camera.rows(values), pose_rows(values, self.camera.poses)
        points, costs = np.empty_like(self._points), np.empty(len(self._points))
        own, shared = self._steps_of(steps)
        old = (camera, poses) if self._at is None else self._at

        def work(i: int) -> None:
            polish_range(
                *self._ranges[i], self._sightings, camera, self.camera.columns, self._points,
                poses, *old, own, shared, steps is not None, self.loss.code,
                float(self.loss.scale), num_steps, tolerance, self._point_costs, points, costs,
            )  # fmt: skip

        run_in_threads(work, len(self._ranges), self.num_threads)
        return points, costs

    def _steps_of(self, steps: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Steps (F, K) of what frames have and (S,) of what they share, of those of all keys."""
        places, common = self.camera.own_places, self.camera.shared_places
        num, kinds = len(self.camera.poses), len(self.camera.of_frames)
        if steps is None:
            return np.zeros((num, len(places))), np.zeros(len(common))
        own = steps[: num * kinds].reshape(num, DIM * kinds)[:, places]
        return np.ascontiguousarray(own), steps[num * kinds :].ravel()[common]

    def _in_blocks(self, sums: Eliminated, stretch: float, cost: float) -> PoseSystem:
        """The sums, their Hessian stretched, as 6x6 blocks of all keys."""
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
        return PoseSystem(stretch * diagonal, stretch * off_diagonal, whole, costs)


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
    lenses: np.ndarray,
    fractions: np.ndarray,
) -> tuple[LensSightings, np.ndarray]:
    """Observations (O, ...) as in `LensSightings`, sorted by landmark and frame, and the row each
    was given in."""
    order = np.lexsort((frames, points))
    offsets = np.zeros(num_points + 1, np.int64)
    np.cumsum(np.bincount(points, minlength=num_points), out=offsets[1:])
    rows = (frames, points, measured, whiteners, lenses, fractions)
    kinds: Sequence[type] = (np.int64, np.int64, float, float, np.int64, float)
    sorted_ = [np.asarray(row)[order].astype(kind) for row, kind in zip(rows, kinds, strict=True)]
    return LensSightings(offsets, *sorted_), order
