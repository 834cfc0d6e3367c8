"""Photometric family: patches of one frame observed in others, planes eliminated."""

import os
from collections.abc import Sequence

import gtsam
import numpy as np

from factors._photometric_kernels import DIMS, PatchData, observe_range
from factors._photometric_schur import eliminate_range
from factors._terms import matrix_rows, moved_rows, pose_rows
from factors.block import Block, PoseSystem
from factors.patch_windows import PatchPixels, covisible_frames, patch_axes, poor_views
from factors.robust import RobustLoss
from factors.threads import balanced_ranges, run_in_threads

FAMILY = "photometric"
_MIN_THREAD_OBSERVATIONS = 128  # least observations of a thread
_MIN_CONTRAST = 1.0  # least standard deviation of a template's grey values


class PhotometricBlock(Block):
    """Patches of any number of frames, each with an inverse-depth plane of its own.

    Implements `factors.block.Block`. `refresh` selects observations at accepted values: those that
    see a patch's back or at a grazing angle, far larger or smaller, or beyond their window are left
    out and counted. A plane never leaves the front of its host: no step takes more than 80% of an
    inverse depth.

    Attributes:
        keys: (F,) keys of the Pose3 variables `world_T_rig`.
        pairs: (Q, 2) int64, rows f < g of keys that share a patch.
        planes: (P, 3) float64, current inverse-depth planes.
        dropped: reason -> observations left out by the last `refresh`.
    """

    def __init__(
        self,
        keys: Sequence[int],
        pixels: PatchPixels,
        sigmas: np.ndarray | float,
        loss: RobustLoss | None = None,
        weights: np.ndarray | None = None,
        num_threads: int | None = None,
        polish_steps: int = 0,
        floor: float = 0.25,
    ) -> None:
        """Normalise the templates.

        Args:
            keys: (F,) keys of Pose3 variables.
            sigmas: (P,) or one, noise of a residual, grey values of a pixel in the host.
            loss: robust loss on the root mean square of a patch's whitened residuals, times the
                number of its pixels; None is plain least squares.
            weights: (O,) of observations, 0 leaves one out; None = 1.
            polish_steps: Gauss-Newton steps on the planes after each proposed pose step.
            floor: grey values added to every contrast in quadrature.

        Raises:
            ValueError: frames are no poses, or sigmas or weights are invalid.
        """
        table = pixels.table
        self.keys = [int(key) for key in keys]
        table.check(len(self.keys))
        self.table, self.planes = table, table.planes.copy()
        self.loss, self.polish_steps = loss or RobustLoss(), polish_steps
        self.num_threads = max(1, num_threads or min(16, os.cpu_count() or 1))
        self.dropped: dict[str, int] = {}
        sigmas = np.broadcast_to(np.asarray(sigmas, dtype=np.float64), (len(table),))
        if not np.all(np.isfinite(sigmas) & (sigmas > 0)):
            raise ValueError("sigmas must be positive and finite")
        base = np.ones(len(table.targets)) if weights is None else np.asarray(weights, float)
        if base.shape != (len(table.targets),) or not np.all(np.isfinite(base) & (base >= 0)):
            raise ValueError(f"weights must be ({len(table.targets)},), finite, not negative")
        self._weights = base
        values = pixels.templates.astype(np.float64)
        values -= values.mean(axis=1, keepdims=True)
        self._flat = values.std(axis=1) < _MIN_CONTRAST
        norms = np.sqrt(np.einsum("pn,pn->p", values, values) + values.shape[1] * floor**2)
        self._data = PatchData(
            table.hosts.astype(np.int32), patch_axes(table.bearings_rig),
            (values / norms[:, None]).astype(np.float32), norms / sigmas,
            table.offsets.astype(np.int64), table.targets.astype(np.int32), base.copy(),
            pixels.pixels(), pixels.starts, pixels.windows, table.grid, pixels.width, floor,
            self.loss.code, float(self.loss.scale),
        )  # fmt: skip
        views, sizes = table.views, (len(table), len(table.targets))
        if views is None:
            nothing = matrix_rows(np.eye(4)[None])
            self._views = tuple(np.repeat(nothing, size, axis=0) for size in sizes)
        else:
            self._views = matrix_rows(views.rig_T_hosts), matrix_rows(views.rig_T_targets)
        self._prior_weights = 1.0 / table.plane_sigmas**2
        self._row_starts, self._columns = covisible_frames(table, len(self.keys))
        rows = np.repeat(np.arange(len(self.keys)), np.diff(self._row_starts))
        self.pairs = np.column_stack([rows, self._columns]).astype(np.int64)
        self._costs = np.full(len(table), np.inf)
        self._trial: tuple[np.ndarray, np.ndarray] | None = None
        self._schur: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def weigh(self, frame_weights: np.ndarray) -> None:
        """Multiply the weights of observations by those (F,) of their host and target."""
        table = self.table
        hosts = table.hosts[table.owners]
        self._weights = self._weights * frame_weights[hosts] * frame_weights[table.targets]

    def weigh_observations(self, weights: np.ndarray) -> None:
        """Multiply the weights of observations by these (O,), 0 leaves one out."""
        self._weights = self._weights * weights

    def refresh(self, values: gtsam.Values) -> None:
        """Select the observations that count."""
        self._data.weights[:] = self._weights
        _, errors = self._observe(pose_rows(values, self.keys), self.planes, 0)
        world_T_rigs = np.array([values.atPose3(key).matrix() for key in self.keys])
        owners = self.table.owners
        lost = 2 * self._data.scales[owners] ** 2 / len(self.table.grid)
        flags = {
            **poor_views(self.table, world_T_rigs, self.planes),
            "outside its window": errors == lost,
            "no contrast": self._flat[owners],
        }
        left = self._weights > 0
        self.dropped = {}
        for reason, flag in flags.items():
            self.dropped[reason] = int(np.count_nonzero(flag & left))
            left &= ~flag
        self._data.weights[~left] = 0.0

    def linearize(self, values: gtsam.Values) -> PoseSystem:
        """Reduced pose system at `values`: robust weights, planes eliminated."""
        poses, data = pose_rows(values, self.keys), self._data
        (hessians, gradients), errors = self._observe(poses, self.planes, DIMS)
        self._costs = self._patch_costs(self.planes, errors)
        num_f, num_p = len(self.keys), len(self.table)
        off = self.planes - self.table.planes
        priors = np.hstack([self._prior_weights, self._prior_weights * off])
        couplings = np.empty((num_p + len(self.table.targets), 3, 6))
        inverses, downs = np.empty((num_p, 3, 3)), np.empty((num_p, 3))
        diagonal, gradient = np.zeros((num_f, 6, 6)), np.zeros((num_f, 6))
        off_diagonal = np.zeros((len(self._columns), 6, 6))
        eliminate_range(
            0, num_p, data.hosts, data.offsets, data.targets, *self._view_rows(poses), *self._views,
            hessians, gradients, priors, self._row_starts, self._columns, diagonal, off_diagonal,
            gradient, couplings, inverses, downs,
        )  # fmt: skip
        self._schur = couplings, inverses, downs
        return PoseSystem(diagonal, off_diagonal, gradient, {FAMILY: float(self._costs.sum())})

    def propose(self, values: gtsam.Values, steps: np.ndarray) -> float:
        """Robust cost at `values`, `steps (F, 6)` from the linearization, with planes moved."""
        if self._schur is None:
            raise RuntimeError("propose() needs linearize() before it")
        couplings, inverses, downs = self._schur
        rows = self.table.offsets[:-1] + np.arange(len(self.table))
        frames = np.insert(self.table.targets, self.table.offsets[:-1], self.table.hosts)
        pulls = np.einsum("oki,oi->ok", couplings, steps[frames])
        downs = downs + (np.add.reduceat(pulls, rows) if len(rows) else np.zeros((0, 3)))
        moved = self._stepped(self.planes, -np.einsum("pij,pj->pi", inverses, downs))
        poses = pose_rows(values, self.keys)
        self._trial = self._better(poses, moved, self.planes, self._costs)
        if self.polish_steps:
            self._trial = self._descend(poses, *self._trial, self.polish_steps)
        return float(self._trial[1].sum())

    def accept(self) -> None:
        """Keep the planes of the last proposal."""
        if self._trial is not None:
            self.planes, self._costs = self._trial
            self._trial = None

    def polish(self, values: gtsam.Values, num_steps: int = 30) -> float:
        """Move the planes to their optimum at fixed poses; returns the robust cost."""
        poses = pose_rows(values, self.keys)
        _, errors = self._observe(poses, self.planes, 0)
        costs = self._patch_costs(self.planes, errors)
        self.planes, self._costs = self._descend(poses, self.planes, costs, num_steps)
        return float(self._costs.sum())

    def costs(self, values: gtsam.Values) -> dict[str, float]:
        """Robust cost at the current planes, including priors on these."""
        errors = self.errors(values)
        return {FAMILY: float(self._patch_costs(self.planes, errors).sum())}

    def errors(self, values: gtsam.Values) -> np.ndarray:
        """Mean square (O,) of each observation's whitened residuals; large where left out."""
        return self._observe(pose_rows(values, self.keys), self.planes, 0)[1]

    def correlations(self, values: gtsam.Values) -> np.ndarray:
        """Normalised correlation (O,) of each observation with its template, 0 where left out."""
        scales = self._data.scales[self.table.owners]
        return 1 - 0.5 * self.errors(values) * len(self.table.grid) / scales**2

    @property
    def weights(self) -> np.ndarray:
        """(O,) weights of observations, 0 where the last `refresh` left one out."""
        return self._data.weights

    @property
    def counted(self) -> np.ndarray:
        """(O,) bool, observations selected by the last `refresh`."""
        return self.weights > 0

    def _observe(self, poses: np.ndarray, planes: np.ndarray, dims: int):
        """Models (hessians, gradients) of the observations, and their mean squares (O,)."""
        num_o = len(self.table.targets)
        size = num_o if dims else 0
        hessians, gradients = np.empty((size, DIMS, DIMS)), np.empty((size, DIMS))
        errors = np.empty(num_o)
        ranges, seen_from = (
            balanced_ranges(self.table.offsets, _MIN_THREAD_OBSERVATIONS),
            self._view_rows(poses),
        )

        def work(i: int) -> None:
            observe_range(
                *ranges[i], self._data, planes, *seen_from, dims, hessians, gradients, errors
            )

        run_in_threads(work, len(ranges), self.num_threads)
        return (hessians, gradients), errors

    def _patch_costs(self, planes: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Robust cost (P,) of each patch, including the prior on its plane."""
        num = len(self.table.grid)
        losses = num * self._data.weights * self.loss.rho(errors)
        off = planes - self.table.planes
        priors = 0.5 * np.einsum("pk,pk->p", self._prior_weights, off * off)
        return priors + np.bincount(self.table.owners, losses, len(self.table))

    def _better(
        self, poses: np.ndarray, new: np.ndarray, old: np.ndarray, least: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The better of two planes for each patch; old ones are only evaluated above `least`."""
        costs = self._patch_costs(new, self._observe(poses, new, 0)[1])
        worse = ~(costs <= least)
        if np.any(worse):
            stay = self._patch_costs(old, self._observe(poses, old, 0)[1])
            worse &= ~(costs <= stay)
            new, costs = np.where(worse[:, None], old, new), np.where(worse, stay, costs)
        return new, costs

    def _descend(
        self, poses: np.ndarray, planes: np.ndarray, costs: np.ndarray, num_steps: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Up to `num_steps` damped Gauss-Newton steps on the planes that never raise a cost."""
        damping = np.full(len(planes), 1e-6)
        for _ in range(num_steps):
            (hessians, gradients), _ = self._observe(poses, planes, 3)
            V, down = (
                np.zeros((len(planes), 3, 3)),
                self._prior_weights * (planes - self.table.planes),
            )
            np.add.at(V, self.table.owners, hessians[:, :3, :3])
            np.add.at(down, self.table.owners, gradients[:, :3])
            V[:, range(3), range(3)] += self._prior_weights
            spread = np.einsum("pkk->pk", V)
            V[:, range(3), range(3)] += (
                damping[:, None] * spread + 1e-200 + 1e-12 * spread.sum(axis=1, keepdims=True)
            )
            step = -np.linalg.solve(V, down[..., None])[..., 0]
            if not np.any(-np.einsum("pk,pk->p", step, down) > 1e-12 * costs):
                break
            trial = self._stepped(planes, step)
            trial_costs = self._patch_costs(trial, self._observe(poses, trial, 0)[1])
            good = trial_costs < costs
            planes = np.where(good[:, None], trial, planes)
            costs = np.where(good, trial_costs, costs)
            damping = np.where(good, 0.1 * damping, np.maximum(1e-3, 10 * damping))
        return planes, costs

    def _stepped(self, planes: np.ndarray, steps: np.ndarray) -> np.ndarray:
        """Planes after steps, shortened if they would lead behind the host."""
        room = 0.8 * planes[:, 0]
        share = np.minimum(1.0, room / np.maximum(-steps[:, 0], 1e-300))
        return planes + share[:, None] * np.where(np.isfinite(steps), steps, 0.0)

    def _view_rows(self, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses (P, 12) of the views that host patches, (O, 12) of those that observe them."""
        seen_from = poses[self._data.hosts], poses[self._data.targets]
        if self.table.views is None:
            return seen_from
        return moved_rows(seen_from[0], self._views[0]), moved_rows(seen_from[1], self._views[1])
