"""The Schur complement of landmarks over poses in factored form: H x without assembling H."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from factors._observations import Visits, visits_of
from factors.compiled import kernel_and_part
from factors.threads import balanced_ranges, map_in_threads, run_in_threads

GROUP_DIM = 7  # degrees of freedom of a group of frames: rotation, translation, scale

_kernel, _part = kernel_and_part(fastmath={"contract"})


@_part
def _take_squares(U, out):
    """out -= U^T U of U (3, 6)."""
    for i in range(6):
        a, b, c = U[0, i], U[1, i], U[2, i]
        for k in range(6):
            out[i, k] -= a * U[0, k] + b * U[1, k] + c * U[2, k]


@_kernel
def project_visits(visits, W, roots, shifts, diagonal, gradient):
    """Subtract the landmarks of a run from the poses' own Hessian and gradient, diagonal (F, 6, 6),
    gradient (F, 6); W becomes U. W (V, 3, 6), roots (L, 6), shifts (L, 3): see
    `factors._kernels.linearize_range`."""
    for j in range(len(visits.offsets) - 1):
        shift = shifts[j]
        r00, r10, r20 = roots[j, 0], roots[j, 1], roots[j, 2]
        r11, r21, r22 = roots[j, 3], roots[j, 4], roots[j, 5]
        for e in range(visits.offsets[j], visits.offsets[j + 1]):
            f, w = visits.frames[e], W[e]
            for i in range(6):
                x, y, z = w[0, i], w[1, i], w[2, i]
                gradient[f, i] -= x * shift[0] + y * shift[1] + z * shift[2]
                w[0, i], w[1, i], w[2, i] = r00 * x, r10 * x + r11 * y, r20 * x + r21 * y + r22 * z
            _take_squares(w, diagonal[f])


@_kernel
def take_products(visits, U, x, out):
    """out (F, 6, R) -= the sum over landmarks of a run of U_f^T sum_g U_g x_g, of x (F, 6, R)."""
    num = x.shape[2]
    u = np.empty((3, num))
    for j in range(len(visits.offsets) - 1):
        u[:] = 0.0
        for e in range(visits.offsets[j], visits.offsets[j + 1]):
            at, w = x[visits.frames[e]], U[e]
            a0, a1, a2, a3, a4, a5 = w[0, 0], w[0, 1], w[0, 2], w[0, 3], w[0, 4], w[0, 5]
            b0, b1, b2, b3, b4, b5 = w[1, 0], w[1, 1], w[1, 2], w[1, 3], w[1, 4], w[1, 5]
            c0, c1, c2, c3, c4, c5 = w[2, 0], w[2, 1], w[2, 2], w[2, 3], w[2, 4], w[2, 5]
            for r in range(num):
                x0, x1, x2, x3, x4, x5 = at[0, r], at[1, r], at[2, r], at[3, r], at[4, r], at[5, r]
                u[0, r] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3 + a4 * x4 + a5 * x5
                u[1, r] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3 + b4 * x4 + b5 * x5
                u[2, r] += c0 * x0 + c1 * x1 + c2 * x2 + c3 * x3 + c4 * x4 + c5 * x5
        for e in range(visits.offsets[j], visits.offsets[j + 1]):
            to, w = out[visits.frames[e]], U[e]
            for i in range(6):
                a, b, c = w[0, i], w[1, i], w[2, i]
                for r in range(num):
                    to[i, r] -= a * u[0, r] + b * u[1, r] + c * u[2, r]


@_kernel
def sum_over_groups(visits, order, over, groups, bases, U, sums):
    """Sum the visits of each landmark of a run over the frames of each group.

    Args:
        order (V,): visits by landmark, then group.
        over: visits of the run's landmarks by groups.
        groups (F,): group of each frame.
        bases (F, 6, 7): motion of each frame when its group moves.
        sums (E, 3, 7): written, the sum of U B over each visit by a group.
    """
    for j in range(len(visits.offsets) - 1):
        to, previous = over.offsets[j] - 1, -1
        for e in range(visits.offsets[j], visits.offsets[j + 1]):
            f = visits.frames[order[e]]
            if groups[f] != previous:
                to, previous = to + 1, groups[f]
                sums[to] = 0.0
            w, basis, total = U[order[e]], bases[f], sums[to]
            for c in range(3):
                for i in range(6):
                    for k in range(GROUP_DIM):
                        total[c, k] += w[c, i] * basis[i, k]


@_kernel
def take_groups(first, last, over, sums, target):
    """Subtract a run's landmarks from rows of groups first..last of target (7 G, 7 G), upper."""
    for g in range(first, last):
        rows = target[GROUP_DIM * g : GROUP_DIM * (g + 1)]
        for e in range(over.row_offsets[g], over.row_offsets[g + 1]):
            visit = over.by_frame[e]
            own = sums[visit]
            for k in range(visit, over.offsets[over.owners[visit] + 1]):
                other, start = sums[k], GROUP_DIM * over.frames[k]
                for r in range(GROUP_DIM):
                    a, b, c = own[0, r], own[1, r], own[2, r]
                    for i in range(GROUP_DIM):
                        rows[r, start + i] -= a * other[0, i] + b * other[1, i] + c * other[2, i]


@_kernel
def add_pairs_of_groups(pairs, blocks, groups, bases, target):
    """Add blocks (P, 6, 6) of pairs (P, 2) of variables to target (7 G, 7 G), upper; groups (N,):
    of each variable, -1 = none; bases (N, 6, 7)."""
    moved = np.empty((6, GROUP_DIM))
    for p in range(len(pairs)):
        i, j = pairs[p, 0], pairs[p, 1]
        g, h = groups[i], groups[j]
        if g < 0 or h < 0:
            continue
        for r in range(6):
            for k in range(GROUP_DIM):
                total = 0.0
                for c in range(6):
                    total += blocks[p, r, c] * bases[j, c, k]
                moved[r, k] = total
        for m in range(GROUP_DIM):
            for k in range(GROUP_DIM):
                total = 0.0
                for r in range(6):
                    total += bases[i, r, m] * moved[r, k]
                row, column = GROUP_DIM * g + m, GROUP_DIM * h + k
                if g <= h:
                    target[row, column] += total
                if g >= h:
                    target[column, row] += total


@_kernel
def merge_capped(rows, columns, most, labels, sizes):
    """Merge groups by pairs, in their order, up to a size of `most`; labels (N,) become roots."""
    for p in range(len(rows)):
        i, j = rows[p], columns[p]
        while labels[i] != i:
            i = labels[i]
        while labels[j] != j:
            j = labels[j]
        if i != j and sizes[i] + sizes[j] <= most:
            if sizes[i] < sizes[j]:
                i, j = j, i
            labels[j] = i
            sizes[i] += sizes[j]
    for n in range(len(labels)):
        i = n
        while labels[i] != i:
            i = labels[i]
        labels[n] = i


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
    """H = own - the sum over landmarks of U^T U, see `project_visits`."""

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
        """Add H projected to groups of poses, labels (F,), to the upper triangle of target (7 G, 7
        G); bases: (F, 6, 7) motion of each pose when its group moves."""
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
