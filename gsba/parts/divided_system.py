"""The normal equations of a map in parts, which `gsba.bundle.optimizer.minimize` solves."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import gtsam
import numpy as np

from factors import RobustLoss
from factors.cholesky import DIM, BlockCholesky
from factors.normal_equations import damping_of
from gsba.bundle.optimizer import OptimizeResult, minimize
from gsba.bundle.pose_variables import X, poses_of
from gsba.config import SolverSettings
from gsba.parts.folder import Index, load, load_index, load_part, values_at
from gsba.parts.jobs import (
    Eliminate,
    Linearize,
    Linearized,
    Move,
    Points,
    Substitute,
    version_file,
)
from gsba.store.records import save_record
from gsba.store.shards import Job, Workers
from gsba.types import Iteration

R = TypeVar("R")

_STATE, _RESULT = "state.npz", "result.npz"


@dataclass(frozen=True, slots=True)
class State:
    """Where a solution stands: what the loop does next depends on nothing else."""

    version: int  # of the parts' landmarks
    poses: np.ndarray  # (F, 12) float64
    damping: float  # of the next attempt


class DividedSystem:
    """Normal equations of a map in parts: what a part owns is eliminated where it lies.

    The frames on the cuts are solved for here, by their Schur complement. Nothing is approximated:
    results differ from those of an undivided system by rounding. They do not depend on the workers.

    Args:
        folder: of the map, from `folder.PartsWriter`.
        workers: who computes the parts.
        loss: robust loss of the observations.
        scratch: folder of the workers' own files, emptied after each pass; None = they have none.
    """

    def __init__(
        self, folder: Path, workers: Workers, loss: RobustLoss, scratch: Path | None = None
    ) -> None:
        self._folder, self._workers, self._loss = folder.absolute(), workers, loss
        self._scratch = scratch
        self._index = index = load_index(folder)
        self.start = State(0, index.poses, np.nan)
        if (folder / _STATE).exists():
            self.start = load(folder / _STATE, State)
        self._version = self._latest = self.start.version
        self._saved: int | None = self._version if self._version else None
        self._frames = [index.frames_of(p) for p in range(len(index.num_kept))]
        self._set_cuts(index)
        self._tentative: list[Linearized] = []
        self._linearized: list[Linearized] = []

    def _set_cuts(self, index: Index) -> None:
        """Fix the pattern of the frames on cuts."""
        kept = [f[len(f) - k :] for f, k in zip(self._frames, index.num_kept, strict=True)]
        self._cut_frames = np.unique(np.concatenate(kept))
        self._rows = [np.searchsorted(self._cut_frames, rows) for rows in kept]  # ascending
        num, codes = len(self._cut_frames), []
        for rows in self._rows:
            i, j = np.triu_indices(len(rows), 1)
            codes.append(rows[i] * num + rows[j])
        self._codes = np.unique(np.concatenate(codes))
        pairs = np.column_stack(np.divmod(self._codes, max(num, 1)))
        self._cholesky = BlockCholesky(num, pairs) if num else None

    def linearize(self, values: gtsam.Values) -> dict[str, float]:
        """See `gsba.bundle.optimizer.System`; parts that just moved are linearized already."""
        self._poses = self._pose_rows(values)
        if not self._linearized:
            each = self._of_parts(self._poses)
            job = Linearize(self._folder, self._all, self._version, each, self._loss)
            self._linearized = self._results(job)
        return self.costs(values)

    def solve(self, damping: float) -> np.ndarray | None:
        """See `gsba.bundle.optimizer.System`."""
        self._save(damping)
        num, pairs = len(self._cut_frames), len(self._codes)
        diagonal, undamped = np.zeros((2, num, DIM, DIM))
        off_diagonal, gradient, raw = np.zeros((pairs, DIM, DIM)), *np.zeros((2, num, DIM))
        job = Eliminate(self._folder, self._all, self._version, damping)
        for p, reduced in enumerate(self._workers.map_shards(job)):
            rows, condensed = self._rows[p], reduced.condensed
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
        steps = np.zeros((len(self._index.poses), DIM))
        self._predicted = 0.0
        if self._cholesky is not None:
            if not self._cholesky.factorize(diagonal, off_diagonal):
                return None
            there = self._cholesky.solve(-gradient)
            steps[self._cut_frames] = there
            self._predicted = 0.5 * float((there * (added * there - raw)).sum())
        kept = tuple(steps[self._cut_frames[rows]] for rows in self._rows)
        job = Substitute(self._folder, self._all, self._version, damping, kept)
        for p, found in enumerate(self._workers.map_shards(job)):
            frames = self._frames[p]
            steps[frames[: len(frames) - len(self._rows[p])]] = found.steps
            self._predicted += found.predicted
        self._clear()
        return steps if np.all(np.isfinite(steps)) else None

    def retract(self, values: gtsam.Values, steps: np.ndarray) -> gtsam.Values:
        """See `gsba.bundle.optimizer.System`."""
        delta = gtsam.VectorValues()
        for frame, step in enumerate(steps):
            delta.insert(X(frame), step)
        return values.retract(delta)

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """See `gsba.bundle.optimizer.System`."""
        self._latest += 1
        poses = self._pose_rows(values)
        job = Move(
            self._folder,
            self._all,
            self._version,
            self._latest,
            self._of_parts(self._poses),
            self._of_parts(poses),
            self._of_parts(steps),
            self._loss,
        )
        moved = self._results(job)
        self._tentative = [part.linearized for part in moved]
        return sum(part.cost for part in moved)

    def predicted_decrease(self) -> float:
        """See `gsba.bundle.optimizer.System`."""
        return self._predicted

    def accept(self, values: gtsam.Values) -> None:
        """See `gsba.bundle.optimizer.System`."""
        self._version, self._linearized = self._latest, self._tentative
        self._poses = self._pose_rows(values)

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """See `gsba.bundle.optimizer.System`."""
        total: dict[str, float] = {}
        for part in self._linearized:
            for name, cost in part.costs.items():
                total[name] = total.get(name, 0.0) + cost
        return total

    def finish(self, values: gtsam.Values) -> None:
        """Note that the solution ended at these values, with the landmarks of this version."""
        state = State(self._version, self._pose_rows(values), np.nan)
        save_record(self._folder / _RESULT, state, {})

    @property
    def _all(self) -> tuple[int, ...]:
        return tuple(range(len(self._frames)))

    def _of_parts(self, rows: np.ndarray) -> tuple[np.ndarray, ...]:
        """Rows of each part's frames, of rows (F, ...) of all frames."""
        return tuple(rows[frames] for frames in self._frames)

    def _pose_rows(self, values: gtsam.Values) -> np.ndarray:
        poses = poses_of(values, len(self._index.poses))
        return np.hstack([poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]])

    def _results(self, job: Job[R]) -> list[R]:
        found = list(self._workers.map_shards(job))
        self._clear()
        return found

    def _clear(self) -> None:
        """Delete the workers' files of a pass that is through."""
        for path in self._scratch.glob("*") if self._scratch is not None else ():
            path.unlink(missing_ok=True)

    def _save(self, damping: float) -> None:
        """Note where the solution stands, and delete older and rejected versions."""
        if self._saved != self._version:
            save_record(self._folder / _STATE, State(self._version, self._poses, damping), {})
            self._saved = self._version
        for path in self._folder.glob("part-*/*-[0-9]*.npz"):
            if not path.stem.endswith(f"-{self._version:06d}"):
                path.unlink(missing_ok=True)


def optimize_divided(
    folder: Path,
    workers: Workers,
    settings: SolverSettings,
    scratch: Path | None = None,
    callback: Callable[[Iteration, gtsam.Values], None] | None = None,
) -> OptimizeResult:
    """Minimize the cost of a map in parts, from where an earlier call was stopped if there is one.

    A call that goes on repeats the attempt that was under way; its result is the same to the byte.

    Args:
        folder: of the map, from `folder.PartsWriter`, on a disk that the workers share.
        workers: who computes the parts.
        settings: loss, damping, tolerances; `max_iterations` counts from where this call starts.
        scratch: folder of the workers' own files, emptied after each pass; None = they have none.
        callback: called with each attempt and the best values so far.

    Raises:
        GsbaError: the disk is full or damaged, the cost at the start is not finite, or workers fail
            again and again.
    """
    loss = RobustLoss(settings.loss, settings.loss_sigmas)
    system = DividedSystem(folder, workers, loss, scratch)
    start = system.start
    if np.isfinite(start.damping):
        settings = settings.model_copy(update={"lambda_initial": start.damping})
    values = values_at(np.arange(len(start.poses)), start.poses)
    result = minimize(system, values, settings, callback)
    system.finish(result.values)
    return result


def read_landmarks(folder: Path, part: int) -> tuple[np.ndarray, np.ndarray]:
    """The landmarks of a part of a map that `optimize_divided` has solved.

    Returns:
        (J,) int64, place of each landmark in the stream that the map was written from; (J, 3)
        float64, world.

    Raises:
        GsbaError: the map is not solved yet, or a file is damaged.
    """
    version = load(folder / _RESULT, State).version
    points = load(version_file(folder, part, "points", version), Points).points_world
    return load_part(folder, part).numbers, points
