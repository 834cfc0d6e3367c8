"""Batched observations of shared landmarks, eliminated inside."""

import os
from collections.abc import Sequence
from functools import cached_property

import gtsam
import numpy as np

from factors._kernels import (
    draw_run,
    eliminate_rows,
    linearize_range,
    polish_range,
    residuals_range,
)
from factors._observations import (
    Observations,
    Term,
    Visits,
    check_term,
    covisible_pairs,
    sort_observations,
    visits_of,
)
from factors._terms import pose_rows
from factors.block import Block, PoseSystem, Products
from factors.robust import RobustLoss
from factors.schur_complement import SchurComplement, project_visits
from factors.threads import balanced_ranges, map_in_threads, run_in_threads

_MAX_VISITS_AT_ONCE = 1 << 17  # visits of landmarks that are eliminated together: 19 MB
_MIN_THREAD_OBSERVATIONS = 1 << 14  # least observations that a thread accumulates on its own


class LandmarkBlock(Block):
    """All observations of a set of landmarks, by any number of families.

    Implements `factors.block.Block`; `factors()` gives ordinary GTSAM factors instead. Threads
    share the work when `num_threads` is above one.

    Attributes:
        keys: (F,) keys of the Pose3 variables `world_T_rig`.
        points_world: (J, 3) float64, current landmarks in the order given.
    """

    def __init__(
        self,
        keys: Sequence[int],
        points_world: np.ndarray,
        terms: Sequence[Term],
        loss: RobustLoss | None = None,
        num_threads: int | None = None,
        polish_steps: int = 3,
    ) -> None:
        """Sort the observations by landmark and frame.

        Args:
            keys: (F,) keys of Pose3 variables, which frames of terms index.
            points_world: (J, 3) start values, world, which points of terms index.
            loss: robust loss on each whitened residual norm; None is plain least squares.
            num_threads: None = number of cores, at most 16.
            polish_steps: Gauss-Newton steps on the landmarks after each proposed pose step.

        Raises:
            ValueError: a key occurs twice, points are not (J, 3), indices are no integers or out of
            range, values not finite, bearings not of length one, or arrays of unequal length.
        """
        self.keys = [int(key) for key in keys]
        self.loss = loss or RobustLoss()
        self.num_threads = max(1, num_threads or min(16, os.cpu_count() or 1))
        self.polish_steps = polish_steps
        self.terms = tuple(terms)
        self.families = tuple(dict.fromkeys(term.name for term in terms))
        if len(set(self.keys)) < len(self.keys):
            raise ValueError("a block must name each of its keys once")
        points = np.array(points_world, dtype=np.float64)
        if points.size and points.shape != (len(points), 3):
            raise ValueError(f"points_world must be (J, 3), not {points.shape}")
        points = points.reshape(-1, 3)
        for term in terms:
            check_term(term, len(self.keys), len(points))
        if not np.all(np.isfinite(points)):
            raise ValueError("points_world must be finite")
        self._obs, self._order, self._point_order = sort_observations(
            self.terms, len(self.keys), len(points), self.loss
        )
        self._points = points[self._point_order]
        self._trial: tuple[np.ndarray, np.ndarray] | None = None
        self._poses: np.ndarray | None = None
        self._point_costs = np.full(len(points), np.inf)

    @cached_property
    def _covisible(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return covisible_pairs(self._obs.offsets, self._obs.frames, len(self.keys))

    @property
    def pairs(self) -> np.ndarray:
        """(P, 2) int64, rows f < g of keys with a common landmark."""
        starts, columns, _ = self._covisible
        rows = np.repeat(np.arange(len(self.keys)), np.diff(starts))
        return np.column_stack([rows, columns])

    @property
    def shared(self) -> np.ndarray:
        """(P,) float32, number of landmarks that each of `pairs` shares."""
        return self._covisible[2]

    @cached_property
    def _visits(self) -> list[Visits]:
        given = self._obs.offsets, self._obs.frames, len(self.keys)
        return visits_of(*given, _MAX_VISITS_AT_ONCE)

    @property
    def visits(self) -> Sequence[Visits]:
        """Visits of its landmarks by frames, in runs."""
        return self._visits

    @property
    def points_world(self) -> np.ndarray:
        """(J, 3) float64, current landmarks in the order they were given."""
        out = np.empty_like(self._points)
        out[self._point_order] = self._points
        return out

    @property
    def point_costs(self) -> np.ndarray:
        """(J,) float64, robust cost of each landmark at the last linearization, in the order that
        landmarks were given."""
        out = np.empty_like(self._point_costs)
        out[self._point_order] = self._point_costs
        return out

    def restore(self, values: gtsam.Values, point_costs: np.ndarray) -> None:
        """Take up the linearization of an equal block: at `values`, with these `point_costs`."""
        self._poses = pose_rows(values, self.keys)
        self._point_costs = np.asarray(point_costs, np.float64)[self._point_order]

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Reduced pose system at `values`: robust weights, landmarks eliminated."""
        self._poses = pose_rows(values, self.keys)
        system, costs, self._point_costs = eliminate_points(
            self._obs, self._visits, self._points, self._poses, *self._covisible[:2],
            len(self.families), self.num_threads,
        )  # fmt: skip
        return PoseSystem(*system, self._named(costs))

    def products(self) -> Products:
        """The block itself, whose `eliminate` gives the Hessian in factored form."""
        return self

    def eliminate(
        self, values: gtsam.Values
    ) -> tuple[SchurComplement, np.ndarray, dict[str, float]]:
        """Factored Hessian, gradient (F, 6), and costs: the model of `linearize` in product
        form."""
        self._poses = pose_rows(values, self.keys)
        complement, gradient, costs, self._point_costs = complement_of(
            self._obs, self._visits, self._points, self._poses, len(self.families),
            self.num_threads,
        )  # fmt: skip
        return complement, gradient, self._named(costs)

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Robust cost at `values`, `steps (F, 6)` from the linearization, with landmarks moved."""
        if self._poses is None:
            raise RuntimeError("propose() needs linearize() before it")
        poses, steps = pose_rows(values, self.keys), np.ascontiguousarray(steps)
        return self._move(poses, self._poses, steps, self.polish_steps, 1e-6)

    def accept(self) -> None:
        """Keep the landmarks of the last proposal."""
        if self._trial is not None:
            self._points, self._point_costs = self._trial
            self._trial = None

    def polish(self, values: gtsam.Values, num_steps: int = 50) -> float:
        """Move the landmarks to their optimum at fixed poses; returns the robust cost."""
        poses = pose_rows(values, self.keys)
        cost = self._move(poses, None, None, num_steps, 1e-12)
        self.accept()
        return cost

    def residuals(self, values: gtsam.Values) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Whitened residuals (O, 2) of each term in its own order, at the current landmarks, and
        (O,) bool, False where the point is behind the face (there the residual is a large
        constant)."""
        residuals, valid = self._residuals(values)
        unsorted, flags = np.empty_like(residuals), np.empty_like(valid)
        unsorted[self._order], flags[self._order] = residuals, valid
        splits = np.cumsum([len(term.frames) for term in self.terms])[:-1]
        return np.split(unsorted, splits), np.split(flags, splits)

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Robust cost of each family at the current landmarks."""
        residuals, _ = self._residuals(values)
        losses = self.loss.rho(np.einsum("ni,ni->n", residuals, residuals))
        totals = np.bincount(self._obs.families, weights=losses, minlength=len(self.families))
        return self._named(totals)

    def error(self, values: gtsam.Values) -> float:
        """Robust cost at the current landmarks."""
        return sum(self.costs(values).values())

    def _residuals(self, values: gtsam.Values) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals (O, 2) and validity (O,), in the order of the sorted observations."""
        poses = pose_rows(values, self.keys)
        residuals = np.empty((len(self._order), 2))
        valid = np.empty(len(self._order), dtype=np.bool_)
        ranges = balanced_ranges(self._obs.offsets)

        def work(i: int) -> None:
            residuals_range(*ranges[i], self._obs, self._points, poses, residuals, valid)

        run_in_threads(work, len(ranges), self.num_threads)
        return residuals, valid

    def _move(
        self,
        poses: np.ndarray,
        old_poses: np.ndarray | None,
        steps: np.ndarray | None,
        num_steps: int,
        tolerance: float,
    ) -> float:
        """Robust cost with landmarks moved on trial; the tolerance is part of a landmark's cost."""
        points, costs = np.empty_like(self._points), np.empty_like(self._point_costs)
        ranges = balanced_ranges(self._obs.offsets)
        substitute = steps is not None

        def work(i: int) -> None:
            polish_range(
                *ranges[i], self._obs, self._points, poses,
                poses if old_poses is None else old_poses,
                np.zeros((len(poses), 6)) if steps is None else steps,
                substitute, num_steps, tolerance, self._point_costs, points, costs,
            )  # fmt: skip

        run_in_threads(work, len(ranges), self.num_threads)
        self._trial = points, costs
        return float(costs.sum())

    def _named(self, costs: np.ndarray) -> dict[str, float]:
        return {name: float(cost) for name, cost in zip(self.families, costs, strict=True)}


def eliminate_points(
    obs: Observations,
    visits: Sequence[Visits],
    points: np.ndarray,
    poses: np.ndarray,
    row_starts: np.ndarray,
    columns: np.ndarray,
    num_families: int,
    num_threads: int,
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Reduced pose system of observations: robust weights, landmarks eliminated.

    Args:
        points: (J, 3) world. poses: (F, 12) as in `factors._kernels`. row_starts, columns: (F +
            1,), (P,) covisible frame pairs i < k as sorted CSR rows.

    Returns:
        Diagonal (F, 6, 6), off-diagonal (P, 6, 6) and gradient (F, 6); robust costs of families
        (T,) and of landmarks (J,).
    """
    num = len(poses)
    diagonal, gradient, costs = np.zeros((num, 6, 6)), np.zeros((num, 6)), np.zeros(num_families)
    off_diagonal, point_costs = np.zeros((len(columns), 6, 6)), np.empty(len(points))
    W = np.empty((max(len(run.frames) for run in visits), 3, 6))
    pattern = row_starts, columns, diagonal, off_diagonal, gradient
    for run in visits:
        _eliminate_run(obs, run, points, poses, W, pattern, costs, point_costs, num_threads)
    return (diagonal, off_diagonal, gradient), costs, point_costs


def _eliminate_run(
    obs: Observations,
    run: Visits,
    points: np.ndarray,
    poses: np.ndarray,
    W: np.ndarray,
    pattern: tuple[np.ndarray, ...],
    costs: np.ndarray,
    point_costs: np.ndarray,
    num_threads: int,
) -> None:
    """Add the landmarks of a run, eliminated; W is scratch for the visits of any run."""
    _, _, diagonal, _, gradient = pattern
    num = len(run.offsets) - 1
    inverses, roots, shifts = np.empty((num, 6)), np.empty((num, 6)), np.empty((num, 3))
    offsets = obs.offsets[run.first : run.first + num + 1]
    ranges, rows = (
        balanced_ranges(offsets - offsets[0], _MIN_THREAD_OBSERVATIONS),
        balanced_ranges(run.row_offsets),
    )

    def add(i: int) -> tuple[np.ndarray, ...]:
        sums = np.zeros_like(diagonal), np.zeros_like(gradient), np.zeros_like(costs)
        first, last = run.first + ranges[i][0], run.first + ranges[i][1]
        linearize_range(
            first, last, obs, run, points, poses, W, inverses, roots, shifts, *sums, point_costs
        )
        return sums

    def reduce(i: int) -> None:
        eliminate_rows(*rows[i], run, W, inverses, shifts, *pattern)

    for part in map_in_threads(add, len(ranges), num_threads):
        for target, more in zip((diagonal, gradient, costs), part, strict=True):
            target += more
    run_in_threads(reduce, len(rows), num_threads)


def complement_of(
    obs: Observations,
    visits: Sequence[Visits],
    points: np.ndarray,
    poses: np.ndarray,
    num_families: int,
    num_threads: int,
) -> tuple[SchurComplement, np.ndarray, np.ndarray, np.ndarray]:
    """The system of `eliminate_points` in factored form: the complement, the gradient (F, 6);
    robust costs of families (T,) and of landmarks (J,)."""
    num = len(poses)
    own, taken, gradient = np.zeros((num, 6, 6)), np.zeros((num, 6, 6)), np.zeros((num, 6))
    costs, point_costs = np.zeros(num_families), np.empty(len(points))
    projected = [np.empty((len(run.frames), 3, 6)) for run in visits]
    roots = [np.empty((len(run.offsets) - 1, 6)) for run in visits]

    def add(i: int) -> tuple[np.ndarray, ...]:
        run, landmarks = visits[i], len(roots[i])
        sums = np.zeros_like(own), np.zeros_like(gradient), np.zeros_like(costs)
        inverses, shifts = np.empty((landmarks, 6)), np.empty((landmarks, 3))
        linearize_range(
            run.first, run.first + landmarks, obs, run, points, poses, projected[i], inverses,
            roots[i], shifts, *sums, point_costs,
        )  # fmt: skip
        out = np.zeros_like(taken)
        project_visits(run, projected[i], roots[i], shifts, out, sums[1])
        return *sums, out

    for part in map_in_threads(add, len(visits), num_threads):
        for target, more in zip((own, gradient, costs, taken), part, strict=True):
            target += more

    def draw(seed: int, num_draws: int) -> np.ndarray:
        def work(i: int) -> np.ndarray:
            out = np.zeros((num, 6, num_draws))
            draw_run(obs, visits[i], points, poses, projected[i], roots[i], np.uint64(seed), out)
            return out

        return sum(map_in_threads(work, len(visits), num_threads), np.zeros((num, 6, num_draws)))

    complement = SchurComplement(own, own + taken, visits, projected, draw, num_threads)
    return complement, gradient, costs, point_costs
