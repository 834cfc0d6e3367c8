"""Levenberg-Marquardt over poses: native factors from a graph, batched blocks beside them."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Protocol

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from factors import Block, RobustLoss
from factors.direct_system import reduced_system
from gsba.log import GsbaError
from gsba.types import Iteration, JointErrors

logger = logging.getLogger(__name__)

_COST_PRECISION = 1e-9  # part of a cost below which its change may be rounding


@dataclass(frozen=True, slots=True)
class SolverOptions:
    """Levenberg-Marquardt: damping, tolerances, and the loss of observations."""

    max_iterations: int = 50
    relative_tolerance: float = 1e-5  # smallest relative decrease of the cost; a smaller one ends
    # the solve
    absolute_tolerance: float | None = 0.05  # upper limit of that threshold, squared standard
    # deviations: the cost of many observations hides what the poses still move; None = no limit
    lambda_initial: float = 1e-4  # damping, part of the diagonal
    loss: RobustLoss = field(default_factory=lambda: RobustLoss("cauchy", 1.0))  # of residuals in
    # standard deviations


@dataclass(frozen=True, slots=True)
class OptimizeResult:
    """Optimized variables and how they came about; landmarks are in their blocks."""

    values: gtsam.Values
    history: tuple[Iteration, ...]
    converged: bool
    reason: str  # why it stopped, one line

    @property
    def cost(self) -> float:
        """Total robust cost of `values`."""
        return next(step.cost for step in reversed(self.history) if step.accepted)


@dataclass(slots=True)
class _Damping:
    """Lambda by the rule of Nielsen (IMM-REP-1999-05): lowered by how well the model predicts."""

    value: float
    growth: float = 2.0

    def raised(self) -> bool:
        """Raise after a rejected step; False where it cannot go higher."""
        self.value, self.growth = self.value * self.growth, self.growth * 2.0
        return self.value <= 1e10

    def lower(self, ratio: float) -> None:
        """Lower after a step whose decrease was `ratio` of the predicted one."""
        self.value = max(self.value * max(0.1, 1 - (2 * ratio - 1) ** 3), 1e-12)
        self.growth = 2.0


@dataclass(slots=True)
class _History:
    """Attempts so far; the caller is told of each."""

    callback: Callable[[Iteration, gtsam.Values], None] | None
    steps: list[Iteration] = field(default_factory=list)
    since: float = field(default_factory=time.perf_counter)  # start of the next attempt

    def add(
        self,
        values: gtsam.Values,
        cost: float,
        costs: Mapping[str, float],
        damping: float,
        accepted: bool,
    ) -> None:
        """Note an attempt that ends now, and the best values after it."""
        seconds = time.perf_counter() - self.since
        step = Iteration(len(self.steps), cost, costs, damping, accepted, seconds)
        self.steps.append(step)
        logger.debug("step %d: cost %.6g, lambda %.1e, %s", step.number, cost, damping, accepted)
        if self.callback is not None:
            self.callback(step, values)
        self.since = time.perf_counter()


class System(Protocol):
    """Normal equations that `minimize` solves again and again, wherever they lie.

    It calls `linearize` at accepted values; then any number of `solve`, `retract` and `propose`, of
    which the last is followed by `accept` if its values are accepted.
    """

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """Model of the cost at accepted values; returns the cost of each family."""
        ...

    def solve(self, damping: float) -> np.ndarray | None:
        """Step (N, 6) of the system damped by `damping` times its diagonal; None if singular."""
        ...

    def retract(self, values: gtsam.Values, steps: np.ndarray) -> gtsam.Values:
        """Values moved by steps (N, 6)."""
        ...

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Total cost at tentative values, `steps (N, 6)` from the linearization point."""
        ...

    def predicted_decrease(self) -> float:
        """Decrease of the cost that the undamped model predicts for the last step."""
        ...

    def accept(self, values: gtsam.Values) -> None:
        """Keep the values of the last proposal, and what moved along with them."""
        ...

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Cost of each family at accepted values."""
        ...


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    blocks: Sequence[Block] = (),
    options: SolverOptions | None = None,
    callback: Callable[[Iteration, gtsam.Values], None] | None = None,
) -> OptimizeResult:
    """Minimize the cost of a graph and of blocks over all variables they name, from `values`; those
    that nothing constrains stay as they are. The blocks then hold the landmarks that belong to the
    result.

    Args:
        graph: native or user factors, on variables of any type; none is a hard constraint.
        blocks: batched factors on Pose3 variables; their landmarks move along.
        options: tolerances and damping; None = the defaults.
        callback: called with each attempt and the best values so far.

    Raises:
        GsbaError: the cost at the start or a Jacobian is not finite, a variable has no value, or a
            factor is a hard constraint (`gtsam.noiseModel.Constrained`).
    """
    options = options or SolverOptions()
    for block in blocks:
        block.refresh(values)
    try:
        system = reduced_system(graph, blocks, values)
    except ValueError as error:
        raise GsbaError(f"{error}") from None
    return minimize(system, values, options, callback)


def _linearized(system: System, values: gtsam.Values) -> dict[str, float]:
    """Cost of each family of a system that is linearized. GsbaError: a Jacobian is not finite."""
    try:
        return system.linearize(values)
    except FloatingPointError as error:
        raise GsbaError(f"{error}: guard its divisions by zero") from None


@threadpool_limits.wrap(limits=1, user_api="blas")  # sums keep their order, fronts are small
def minimize(
    system: System,
    values: gtsam.Values,
    options: SolverOptions,
    callback: Callable[[Iteration, gtsam.Values], None] | None = None,
) -> OptimizeResult:
    """Minimize the cost of a system by Levenberg-Marquardt: `optimize`, of any system. GsbaError:
    the cost at the start or a Jacobian is not finite."""
    history = _History(callback)

    def result(converged: bool, reason: str) -> OptimizeResult:
        return OptimizeResult(values, tuple(history.steps), converged, reason)

    costs = _linearized(system, values)
    bad = [name for name, part in costs.items() if not np.isfinite(part)]
    if bad:
        raise GsbaError(f"the cost of {', '.join(bad)} is not finite at the start: check its input")
    cost = sum(costs.values())
    damping = _Damping(options.lambda_initial)
    promised = 0.0  # largest decrease predicted for a step rejected since the last accepted one
    history.add(values, cost, costs, damping.value, True)
    for _ in range(options.max_iterations):
        negligible = options.relative_tolerance * cost
        if options.absolute_tolerance is not None:
            negligible = min(negligible, options.absolute_tolerance)
        used = damping.value
        steps = system.solve(used)
        trial, trial_cost, predicted = values, np.inf, np.inf
        if steps is not None:
            trial = system.retract(values, steps)
            trial_cost, predicted = system.propose(trial, steps), system.predicted_decrease()
            promised = max(promised, predicted)
        if not trial_cost <= cost:  # also where it is not a number
            history.add(values, trial_cost, {}, used, False)
            if predicted <= negligible:
                if promised > max(negligible, _COST_PRECISION * cost):
                    return result(False, "no step decreases the cost as the Jacobians predict")
                return result(True, "no step decreases the cost")
            if not damping.raised():
                return result(False, "no damping gives a good step")
            continue
        system.accept(trial)
        values, decrease, promised = trial, cost - trial_cost, 0.0
        damping.lower(decrease / predicted if predicted > 0 else 1.0)
        # a small step says nothing about convergence where damping made it small, and a long chain
        # of frames bends by modes of 1e-6 of the diagonal
        converged = decrease <= negligible and used <= 1e-6
        costs = system.costs(values) if converged else _linearized(system, values)
        cost = sum(costs.values())
        history.add(values, cost, costs, used, True)
        if converged:
            return result(True, f"decrease below {negligible:.3g}")
    return result(False, "iteration limit")


@threadpool_limits.wrap(limits=1, user_api="blas")
def marginal_covariances(
    graph: gtsam.NonlinearFactorGraph,
    blocks: Sequence[Block],
    values: gtsam.Values,
    keys: Sequence[int],
    num_draws: int = 0,
    seed: int = 0,
    beside: Sequence[int] = (),
) -> tuple[np.ndarray, JointErrors]:
    """Marginal covariances of Pose3 variables, keys (F,) in the order of the path, and of others
    beside them (B,), of at most six dimensions; and what errors of poses have in common, by
    num_draws errors drawn of all at once.

    Returns:
        (F + B, 6, 6) float64, [rotation rad, translation], rig frame, and joint errors. NaN for
        one that nothing constrains, and for all where the rest is singular (the gauge is not
        fixed).
    """
    num = len(keys)
    for block in blocks:
        block.refresh(values)
    system = reduced_system(graph, blocks, values, list(pairwise(keys)))
    _linearized(system, values)
    found = system.covariances(num_draws, np.random.default_rng(seed))
    if found is None:
        nothing = np.full((num_draws, num, 6), np.nan, np.float32)
        return np.full((num + len(beside), 6, 6), np.nan), JointErrors(
            np.full((num - 1, 6, 6), np.nan), nothing
        )
    inverse, between, drawn = found
    rows = [system.first_block[key] for key in (*keys, *beside)]
    return inverse[rows], JointErrors(between, drawn[:, rows[:num]].astype(np.float32))
