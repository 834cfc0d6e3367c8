"""Passes over parts where these lie: files in, files out, the same bytes whoever computes. At
version V, of accepted or tentative poses, `points-V.npz` holds landmarks, `equations-V.npz` normal
equations."""

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import gtsam
import numpy as np

from factors import LandmarkBlock, RobustLoss
from factors.part_system import Condensed, PartElimination, PartEquations, PartSystem
from factors.system_layout import SystemLayout
from gsba.bundle.pose_variables import X
from gsba.memory import total_memory_bytes
from gsba.parts.folder import At, MapPart, deserialized, load, load_part, part_folder
from gsba.store.records import save_record
from gsba.store.shards import even_blocks

_MEMORY_SHARE = 64  # of the machine's memory: a process keeps factors of this part of it at most

_Key = tuple[str, int, int, float]  # file, its inode, time of writing, damping


_kept: dict[_Key, PartElimination] = {}
_lock = threading.Lock()  # of `_kept`


def substituting(file: Path, damping: float) -> PartElimination:
    """The factor that `eliminated` returned, which is kept no longer, or computed again."""
    with _lock:
        factor = _kept.pop(_key(file, damping), None)
    return PartElimination(load(file, PartEquations), damping) if factor is None else factor


def _key(file: Path, damping: float) -> _Key:
    stat = file.stat()
    return str(file), stat.st_ino, stat.st_mtime_ns, damping


@dataclass(frozen=True, slots=True)
class PartPoints:
    """Landmarks of a part at a version."""

    points_world: np.ndarray  # (J, 3) float64
    costs: np.ndarray  # (J,) float64, robust cost of each


@dataclass(frozen=True, slots=True)
class Linearized:
    """Costs of a part, and its share of the equations of its nodes on cuts."""

    costs: Mapping[str, float]  # family -> cost
    diagonal: np.ndarray  # (K, 6, 6) float64, the part's own share of H, nothing damped
    gradient: np.ndarray  # (K, 6) float64


def version_file(folder: Path, part: int, name: str, version: int) -> Path:
    """File `name` of a part at a version."""
    return part_folder(folder, part) / f"{name}-{version:06d}.npz"


@dataclass(frozen=True)
class _PartJob:
    """A pass over parts; tuples have an entry for each of them."""

    folder: Path  # of the map
    parts: tuple[int, ...]
    version: int

    def __len__(self) -> int:
        return len(self.parts)

    def blocks(self) -> Sequence[tuple[int, int]]:
        """One part for one worker."""
        return even_blocks(len(self.parts), 1)

    def part(self, start: int, stop: int) -> Self:
        """See `gsba.store.shards.Job`."""
        every = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        each = {name: value for name, value in every.items() if isinstance(value, tuple)}
        return replace(self, **{name: value[start:stop] for name, value in each.items()})

    def _file(self, item: int, name: str, version: int) -> Path:
        return version_file(self.folder, self.parts[item], name, version)


@dataclass(frozen=True)
class Linearize(_PartJob):
    """Linearizes parts at values, with the landmarks they have at a version."""

    at: tuple[At, ...]  # each part's variables
    loss: RobustLoss
    pairs: tuple[np.ndarray, ...] = ()  # (Q, 2) int64, frames of each part that its pattern pairs
    # as well; () = none

    title = "linearizing"
    returns: Any = Linearized

    def __call__(self, item: int) -> Linearized:
        part = load_part(self.folder, self.parts[item])
        points = part.sightings.points_world
        if self.version:
            points = load(self._file(item, "points", self.version), PartPoints).points_world
        block, graph = _block(part, points, self.loss), deserialized(part.graph)
        values = self.at[item].values(part.frames)
        pairs = [(X(f), X(g)) for f, g in self.pairs[item].tolist()] if self.pairs else ()
        linearized, equations = _linearized(part, block, graph, values, pairs)
        save_record(self._file(item, "equations", self.version), equations, {})
        points = PartPoints(block.points_world, block.point_costs)
        save_record(self._file(item, "points", self.version), points, {})
        return linearized


@dataclass(frozen=True)
class Move(_PartJob):
    """Moves parts from a version to another one, and linearizes them there."""

    to: int  # version
    before: tuple[At, ...]  # each part's variables at the version
    after: tuple[At, ...]  # at the other one
    steps: tuple[np.ndarray, ...]  # (N, 6) of each part's frames between
    loss: RobustLoss

    title = "moving"
    returns: Any = tuple[float, Linearized]  # cost, and the part there

    def __call__(self, item: int) -> tuple[float, Linearized]:
        part = load_part(self.folder, self.parts[item])
        points = load(self._file(item, "points", self.version), PartPoints)
        block, graph = _block(part, points.points_world, self.loss), deserialized(part.graph)
        block.restore(self.before[item].values(part.frames), points.costs)
        values = self.after[item].values(part.frames)
        cost = block.propose(values, self.steps[item])
        if graph.size():
            cost += graph.error(values)
        block.accept()
        linearized, equations = _linearized(part, block, graph, values)
        save_record(self._file(item, "equations", self.to), equations, {})
        moved = PartPoints(block.points_world, block.point_costs)
        save_record(self._file(item, "points", self.to), moved, {})
        return cost, linearized


@dataclass(frozen=True)
class Eliminate(_PartJob):
    """Eliminates the own nodes of parts."""

    damping: float

    title = "eliminating"
    returns: Any = Condensed | None  # equations on nodes on cuts; None = its block is singular

    def __call__(self, item: int) -> Condensed | None:
        # The factor is kept for `substituting` while all that are kept take a share of the memory.
        file = self._file(item, "equations", self.version)
        factor = PartElimination(load(file, PartEquations), self.damping)
        if factor.regular:
            with _lock:
                for old in [old for old in _kept if old[0] == str(file)]:
                    del _kept[old]
                num_bytes = sum(one.num_bytes for one in [factor, *_kept.values()])
                if num_bytes <= total_memory_bytes() // _MEMORY_SHARE:
                    _kept[_key(file, self.damping)] = factor
        return factor.condensed() if factor.regular else None


@dataclass(frozen=True)
class Substitute(_PartJob):
    """Finds the steps of parts' own nodes from those of nodes on cuts."""

    damping: float
    kept: tuple[np.ndarray, ...]  # (K, 6) steps of each part's nodes on cuts

    title = "substituting"
    # Steps (N - K, 6) float64, and the share of the decrease that the model predicts.
    returns: Any = tuple[np.ndarray, float]

    def __call__(self, item: int) -> tuple[np.ndarray, float]:
        factor = substituting(self._file(item, "equations", self.version), self.damping)
        return factor.substituted(self.kept[item])


@dataclass(frozen=True, slots=True)
class Shared:
    """Covariances of a part's nodes on cuts, which `Covariances` starts from."""

    inverse: np.ndarray  # (6 K, 6 K) float64, of the map's system
    drawn: np.ndarray  # (D, K, 6) float64, errors of its covariance


@dataclass(frozen=True)
class Covariances(_PartJob):
    """Blocks of the map's inverse at parts' own nodes, and errors drawn of it.

    `shared-V.npz` holds the inverse at a part's nodes on cuts.
    """

    pairs: tuple[np.ndarray, ...]  # (Q, 2) int64, places among each part's nodes
    seed: int  # of the draws, beside the part's number

    title = "covariances"
    # (N - K, 6, 6) float64, (Q, 6, 6) float64 between pairs, and drawn (D, N - K, 6) float32.
    returns: Any = tuple[np.ndarray, np.ndarray, np.ndarray]

    def __call__(self, item: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shared = load(self._file(item, "shared", self.version), Shared)
        factor = substituting(self._file(item, "equations", self.version), 0.0)
        inverse, between = factor.inverse_blocks(self.pairs[item], shared.inverse)
        rng = np.random.default_rng([self.seed, self.parts[item]])
        drawn = factor.drawn(shared.drawn, rng).astype(np.float32)
        inverse[factor.idle], drawn[:, factor.idle] = np.nan, np.nan
        return inverse, between, drawn


def _block(part: MapPart, points_world: np.ndarray, loss: RobustLoss) -> LandmarkBlock:
    keys = [X(frame) for frame in part.frames.tolist()]
    return LandmarkBlock(keys, points_world, part.sightings.terms, loss, num_threads=1)


def _linearized(
    part: MapPart,
    block: LandmarkBlock,
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    pairs: Sequence[tuple[int, int]] = (),
) -> tuple[Linearized, PartEquations]:
    system = PartSystem(SystemLayout(graph, [block], values, pairs, part.keys.tolist()))
    costs = system.linearize(values)
    equations = system.equations(part.num_kept)
    kept = slice(len(equations.diagonal) - part.num_kept, None)
    return Linearized(costs, equations.diagonal[kept], equations.gradient[kept]), equations
