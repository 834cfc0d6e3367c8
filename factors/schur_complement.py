"""The Schur complement of landmarks over poses in factored form: H x without assembling H."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from factors._observations import Visits, visits_of
from factors._schur_kernels import (
    GROUP_DIM,
    sum_over_groups,
    take_groups,
    take_products,
)
from factors.threads import balanced_ranges, map_in_threads, run_in_threads


@dataclass(frozen=True, slots=True)
class GroupVisits:
    """Visits of a run of landmarks by groups of frames."""

    order: np.ndarray  # (V,) int32, the run's visits by landmark, then group
    over: Visits  # visits by groups


def group_visits(runs: Sequence[Visits], labels: np.ndarray, num_groups: int) -> list[GroupVisits]:
    """Visits of each run's landmarks by groups of frames `labels (F,)`."""
    out = []
    for run in runs:
        groups = labels[run.frames]
        order = np.argsort(run.owners * np.int64(num_groups) + groups, kind="stable")
        (over,) = visits_of(run.offsets, groups[order], num_groups, len(order) + 1)
        out.append(GroupVisits(order.astype(np.int32), over))
    return out


@dataclass(frozen=True, slots=True)
class SchurComplement:
    """H = own - the sum over landmarks of U^T U, see `factors._schur_kernels`."""

    own: np.ndarray  # (F, 6, 6) blocks of the poses alone
    diagonal: np.ndarray  # (F, 6, 6) blocks H[f, f]
    runs: Sequence[Visits]
    projected: Sequence[np.ndarray]  # (V, 3, 6) U of each run's visits
    draw: Callable[[int, int], np.ndarray]  # vectors (F, 6, R) of covariance H, given a seed and R
    num_threads: int

    def times(self, x: np.ndarray) -> np.ndarray:
        """H x of vectors (F, 6, R)."""
        out = self.own @ x

        def work(i: int) -> np.ndarray:
            part = np.zeros_like(out)
            take_products(self.runs[i], self.projected[i], x, part)
            return part

        for part in map_in_threads(work, len(self.runs), self.num_threads):
            out += part
        return out

    def add_to_groups(
        self,
        labels: np.ndarray,
        bases: np.ndarray,
        visits: Sequence[GroupVisits],
        target: np.ndarray,
    ) -> None:
        """Add H projected to groups of poses.

        Args:
            labels: (F,) group of each pose.
            bases: (F, 6, 7) motion of each pose when its group moves.
            target: (7 G, 7 G), only the upper triangle is written.
        """
        for run, projected, by_group in zip(self.runs, self.projected, visits, strict=True):
            over = by_group.over
            sums = np.empty((len(over.frames), 3, GROUP_DIM))
            sum_over_groups(run, by_group.order, over, labels, bases, projected, sums)
            _take_run(over, sums, target, self.num_threads)


def _take_run(over: Visits, sums: np.ndarray, target: np.ndarray, num_threads: int) -> None:
    """Subtract the landmarks of a run from the projected system, by ranges of its rows."""
    rows = balanced_ranges(over.row_offsets)

    def work(i: int) -> None:
        take_groups(*rows[i], over, sums, target)

    run_in_threads(work, len(rows), num_threads)
