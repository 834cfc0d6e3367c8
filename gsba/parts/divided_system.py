"""The normal equations of a map in parts, which `gsba.bundle.optimizer.minimize` solves."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np
from threadpoolctl import threadpool_limits

from factors import RobustLoss
from factors.cholesky import DIM, BlockCholesky
from factors.normal_equations import damping_of
from gsba.bundle.families import kept
from gsba.bundle.optimizer import OptimizeResult, SolverOptions, minimize
from gsba.bundle.pose_variables import X
from gsba.parts.folder import At, load, load_index, load_part
from gsba.parts.jobs import (
    Covariances,
    Eliminate,
    Linearize,
    Linearized,
    Move,
    Shared,
    Substitute,
    version_file,
)
from gsba.store.records import save_record
from gsba.store.shards import Job, Workers
from gsba.types import JointErrors

R = TypeVar("R")

_STATE, _RESULT = "state.npz", "result.npz"


@dataclass(frozen=True, slots=True)
class SolverState:
    """Where a solution stands: what the loop does next depends on nothing else."""

    version: int  # of the parts' landmarks
    at: At  # all variables
    damping: float  # of the next attempt
    attempts: int  # before it, in all calls


class DividedSystem:
    """Normal equations of a map in parts: what a part owns is eliminated where it lies.

    The variables on the cuts are solved for here, by their Schur complement. Nothing is
    approximated: results differ from those of an undivided system by rounding. They do not depend
    on the workers.

    Args:
        folder: of the map, from `folder.PartsWriter`.
        scratch: folder of the workers' own files, emptied after each pass; None = they have none.

    Attributes:
        start: where an earlier call was stopped, or the map's own start.
        num_frames: F.
        nodes: nodes (N,) of each part, its own ones first; frames are the first F of the map.
        kept: places (K,) in `cut_nodes` of each part's nodes on cuts, ascending.
        cut_nodes: (C,) nodes on cuts, ascending.
    """

    def __init__(
        self, folder: Path, workers: Workers, loss: RobustLoss, scratch: Path | None = None
    ) -> None:
        self._folder, self._workers, self._loss = folder.absolute(), workers, loss
        self._scratch = scratch
        index = load_index(folder)
        self.start = SolverState(0, index.start, np.nan, 0)
        if (folder / _STATE).exists():
            self.start = load(folder / _STATE, SolverState)
        self._version = self._latest = self.start.version
        self._attempts = self.start.attempts
        self._saved: int | None = self._version if self._version else None
        self.num_frames = len(index.start.poses)
        self._beside = index.start.beside.keys.tolist()
        self.nodes = [index.nodes_of(p) for p in range(len(index.num_kept))]
        parts = (load_part(folder, p) for p in range(len(self.nodes)))
        self._variables = [(part.frames, part.beside) for part in parts]  # of each, not its points
        dims = self.start.at.values(range(self.num_frames)).dims()
        self._dims = [dims[key] for key in self._beside]  # of variables that are no frames
        firsts = np.cumsum([self.num_frames, *(-(-dim // DIM) for dim in self._dims)])
        self._firsts, self._num_nodes = firsts[:-1].tolist(), int(firsts[-1])
        # Fix the pattern of the nodes on cuts
        kept = [n[len(n) - k :] for n, k in zip(self.nodes, index.num_kept, strict=True)]
        self.cut_nodes = np.unique(np.concatenate(kept))
        self.kept = [np.searchsorted(self.cut_nodes, rows) for rows in kept]
        num, codes = len(self.cut_nodes), []
        for rows in self.kept:
            i, j = np.triu_indices(len(rows), 1)
            codes.append(rows[i] * num + rows[j])
        self._codes = np.unique(np.concatenate(codes))
        pairs = np.column_stack(np.divmod(self._codes, max(num, 1)))
        self._cholesky = BlockCholesky(num, pairs) if num else None
        self._tentative: list[Linearized] = []
        self._linearized: list[Linearized] = []

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """See `gsba.bundle.optimizer.System`; parts that just moved are linearized already."""
        self._at = self._of(values)
        if not self._linearized:
            each = self._of_parts(values)
            job = Linearize(self._folder, self._all, self._version, each, self._loss)
            self._linearized = self._results(job)
        return self.costs(values)

    def solve(self, damping: float) -> np.ndarray | None:
        """See `gsba.bundle.optimizer.System`; steps (N, 6) of frames, then of other variables."""
        # Note where the solution stands, and delete older and rejected versions
        if self._saved != self._version:
            state = SolverState(self._version, self._at, damping, self._attempts)
            save_record(self._folder / _STATE, state, {})
            self._saved = self._version
        self._attempts += 1
        for path in self._folder.glob("part-*/*-[0-9]*.npz"):
            if not path.stem.endswith(f"-{self._version:06d}"):
                path.unlink(missing_ok=True)
        factorized = self._factorized(damping)
        if factorized is None:
            return None
        steps = np.zeros((self._num_nodes, DIM))
        self._predicted = 0.0
        if self._cholesky is not None:
            added, gradient, raw = factorized
            there = self._cholesky.solve(-gradient)
            steps[self.cut_nodes] = there
            self._predicted = 0.5 * float((there * (added * there - raw)).sum())
        kept = tuple(steps[self.cut_nodes[rows]] for rows in self.kept)
        job = Substitute(self._folder, self._all, self._version, damping, kept)
        for p, (own, predicted) in enumerate(self._workers.map_shards(job)):
            nodes = self.nodes[p]
            steps[nodes[: len(nodes) - len(self.kept[p])]] = own
            self._predicted += predicted
        self._clear()
        return steps if np.all(np.isfinite(steps)) else None

    def _factorized(self, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Addition to the diagonal, gradients without and with parts, (C, 6); None = singular."""
        num, pairs = len(self.cut_nodes), len(self._codes)
        diagonal, undamped = np.zeros((2, num, DIM, DIM))
        off_diagonal, gradient, raw = np.zeros((pairs, DIM, DIM)), *np.zeros((2, num, DIM))
        job = Eliminate(self._folder, self._all, self._version, damping)
        for p, condensed in enumerate(self._workers.map_shards(job)):
            rows = self.kept[p]
            if condensed is None:
                return None
            i, j = np.triu_indices(len(rows), 1)
            off_diagonal[np.searchsorted(self._codes, rows[i] * num + rows[j])] += (
                condensed.off_diagonal
            )
            diagonal[rows] += condensed.diagonal
            gradient[rows] += condensed.gradient
            undamped[rows] += self._linearized[p].diagonal
            raw[rows] += self._linearized[p].gradient
        self._clear()
        added = damping_of(undamped, damping)
        np.einsum("nii->ni", diagonal)[:] += added
        self.idle = ~np.any(undamped, axis=(1, 2))
        if damping == 0:
            diagonal[self.idle] = np.eye(DIM)
        if self._cholesky is not None and not self._cholesky.factorize(diagonal, off_diagonal):
            return None
        return added, gradient, raw

    def covariances(
        self, pairs: np.ndarray, num_draws: int, seed: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Blocks of H^-1 at the start, and draws from it; None if singular.

        Args:
            pairs: (Q, 2) frames that the writer was to tie.

        Returns:
            (N, 6, 6) diagonal blocks, (Q, 6, 6) blocks between the pairs, and vectors (D, N, 6)
            float32 of covariance H^-1; NaN where nothing constrains a node.
        """
        local = [_places(nodes, pairs) for nodes in self.nodes]
        own = [len(n) - len(k) for n, k in zip(self.nodes, self.kept, strict=True)]
        asked = [np.flatnonzero((p >= 0).all(axis=1) & (p.min(axis=1) < num))
                 for p, num in zip(local, own, strict=True)]  # fmt: skip
        inside = tuple(p[rows] for p, rows in zip(local, asked, strict=True))
        each = self._of_parts(self.start.at.values(range(self.num_frames)))
        tied = tuple(pairs[rows] for rows in asked)
        job = Linearize(self._folder, self._all, self._version, each, self._loss, tied)
        self._linearized = self._results(job)
        if self._factorized(0.0) is None:
            return None
        inverse = np.empty((self._num_nodes, DIM, DIM))
        between = np.full((len(pairs), DIM, DIM), np.nan)
        drawn = np.empty((num_draws, self._num_nodes, DIM), np.float32)
        self._invert_cuts(pairs, seed, inverse, between, drawn)
        job = Covariances(self._folder, self._all, self._version, inside, seed)
        for p, found in enumerate(self._workers.map_shards(job)):
            nodes = self.nodes[p][: own[p]]
            inverse[nodes], between[asked[p]], drawn[:, nodes] = found
        self._clear()
        between[np.isnan(inverse[pairs]).any(axis=(1, 2, 3))] = np.nan
        return inverse, between, drawn

    def _invert_cuts(
        self,
        pairs: np.ndarray,
        seed: int,
        inverse: np.ndarray,
        between: np.ndarray,
        drawn: np.ndarray,
    ) -> None:
        """Fill in the results of `covariances` at the nodes on cuts; parts get theirs in files."""
        num, codes = len(self.cut_nodes), self._codes
        on_cuts, joint = np.zeros((num, DIM, DIM)), np.zeros((len(codes), DIM, DIM))
        errors = np.zeros((len(drawn), num, DIM))
        if self._cholesky is not None:
            rng = np.random.default_rng(seed)
            on_cuts, joint = self._cholesky.inverse_blocks(np.column_stack(np.divmod(codes, num)))
            errors = self._cholesky.draw(rng.normal(size=errors.shape))
        for p, rows in enumerate(self.kept):
            whole = np.zeros((len(rows), DIM, len(rows), DIM))
            each, (i, j) = np.arange(len(rows)), np.triu_indices(len(rows), 1)
            blocks = joint[np.searchsorted(codes, rows[i] * num + rows[j])]
            whole[each, :, each, :], whole[i, :, j, :] = on_cuts[rows], blocks
            whole[j, :, i, :] = np.swapaxes(blocks, 1, 2)
            shared = Shared(whole.reshape(2 * (DIM * len(rows),)), errors[:, rows])
            save_record(version_file(self._folder, p, "shared", self._version), shared, {})
        on_cuts[self.idle], errors[:, self.idle] = np.nan, np.nan
        inverse[self.cut_nodes], drawn[:, self.cut_nodes] = on_cuts, errors
        places = _places(self.cut_nodes, pairs)
        both = np.flatnonzero((places >= 0).all(axis=1))
        between[both] = joint[np.searchsorted(codes, places[both] @ [num, 1])]

    def retract(self, values: gtsam.Values, steps: np.ndarray) -> gtsam.Values:
        """See `gsba.bundle.optimizer.System`."""
        delta = gtsam.VectorValues()
        for frame in range(self.num_frames):
            delta.insert(X(frame), steps[frame])
        flat = steps.ravel()
        for key, dim, first in zip(self._beside, self._dims, self._firsts, strict=True):
            delta.insert(key, flat[DIM * first : DIM * first + dim])
        return values.retract(delta)

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """See `gsba.bundle.optimizer.System`."""
        self._latest += 1
        before = self._of_parts(self._at.values(range(self.num_frames)))
        job = Move(
            self._folder,
            self._all,
            self._version,
            self._latest,
            before,
            self._of_parts(values),
            tuple(steps[frames] for frames, _ in self._variables),
            self._loss,
        )
        moved = self._results(job)
        self._tentative = [linearized for _, linearized in moved]
        return sum(cost for cost, _ in moved)

    def predicted_decrease(self) -> float:
        """See `gsba.bundle.optimizer.System`."""
        return self._predicted

    def accept(self, values: gtsam.Values) -> None:
        """See `gsba.bundle.optimizer.System`."""
        self._version, self._linearized = self._latest, self._tentative
        self._at = self._of(values)

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """See `gsba.bundle.optimizer.System`."""
        total: dict[str, float] = {}
        for part in self._linearized:
            for name, cost in part.costs.items():
                total[name] = total.get(name, 0.0) + cost
        return total

    def finish(self, values: gtsam.Values) -> None:
        """Note that the solution ended at these values, with the landmarks of this version."""
        state = SolverState(self._version, self._of(values), np.nan, self._attempts)
        save_record(self._folder / _RESULT, state, {})

    @property
    def _all(self) -> tuple[int, ...]:
        return tuple(range(len(self.nodes)))

    def _of(self, values: gtsam.Values) -> At:
        return At.of(values, range(self.num_frames), self._beside)

    def _of_parts(self, values: gtsam.Values) -> tuple[At, ...]:
        poses, nothing = self._of(values).poses, At.of(values, (), ()).beside
        return tuple(
            At(poses[frames], kept(values, beside) if beside else nothing)
            for frames, beside in self._variables
        )

    def _results(self, job: Job[R]) -> list[R]:
        found = list(self._workers.map_shards(job))
        self._clear()
        return found

    def _clear(self) -> None:
        """Delete the workers' files of a pass that is through."""
        for path in self._scratch.glob("*") if self._scratch is not None else ():
            path.unlink(missing_ok=True)


def _places(nodes: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Places (Q, 2) of pairs of nodes in `nodes (N,)`; -1 = not among them."""
    order = np.argsort(nodes)
    at = np.minimum(np.searchsorted(nodes, pairs, sorter=order), max(len(nodes) - 1, 0))
    if not len(nodes):
        return np.full(pairs.shape, -1)
    return np.where(nodes[order[at]] == pairs, order[at], -1)


def optimize_divided(
    folder: Path, workers: Workers, options: SolverOptions, scratch: Path | None = None
) -> OptimizeResult:
    """Minimize the cost of a map in parts, from where an earlier call was stopped if there is one.

    A call that goes on repeats the attempt that was under way; its result is the same to the byte.

    Args:
        folder: of the map, from `folder.PartsWriter`, on a disk that the workers share.
        options: loss, damping, tolerances; `max_iterations` of all calls together.
        scratch: folder of the workers' own files, emptied after each pass; None = they have none.

    Raises:
        GsbaError: the disk is full or damaged, the cost at the start is not finite, or workers fail
            again and again.
    """
    system = DividedSystem(folder, workers, options.loss, scratch)
    start = system.start
    if np.isfinite(start.damping):
        left = options.max_iterations - start.attempts
        options = replace(options, lambda_initial=start.damping, max_iterations=left)
    values = start.at.values(range(system.num_frames))
    result = minimize(system, values, options)
    system.finish(result.values)
    return result


@threadpool_limits.wrap(limits=1, user_api="blas")
def divided_covariances(
    folder: Path,
    workers: Workers,
    loss: RobustLoss,
    num_draws: int = 0,
    seed: int = 0,
    scratch: Path | None = None,
) -> tuple[np.ndarray, JointErrors]:
    """Marginal covariances of the poses of a map in parts, where it starts.

    As `gsba.bundle.optimizer.marginal_covariances`, which it equals within rounding where that
    factorizes; the errors drawn are other ones of the same distribution.

    Args:
        folder: of the map, from `folder.PartsWriter`, which was to `tie` neighbouring frames.
        num_draws: errors drawn of all poses at once, D.
        scratch: folder of the workers' own files; None = they have none.

    Returns:
        (F, 6, 6) float64, [rotation rad, translation], rig frame, and joint errors. NaN for one
        that nothing constrains, and for all where the rest is singular (the gauge is not fixed).

    Raises:
        GsbaError: the disk is full or damaged, or workers fail again and again.
    """
    system = DividedSystem(folder, workers, loss, scratch)
    num = system.num_frames
    steps = np.column_stack([np.arange(num - 1), np.arange(1, num)])
    found = system.covariances(steps, num_draws, seed)
    if found is None:
        nothing = np.full((num_draws, num, 6), np.nan, np.float32)
        return np.full((num, 6, 6), np.nan), JointErrors(np.full((num - 1, 6, 6), np.nan), nothing)
    inverse, between, drawn = found
    return inverse[:num], JointErrors(between, drawn[:, :num])
