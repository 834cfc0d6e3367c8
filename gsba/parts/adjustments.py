"""Adjustments of a run in parts: written where its workers see them, solved there, resumed."""

import logging
from dataclasses import dataclass, field
from pathlib import Path

import gtsam
import numpy as np

from gsba.bundle.adjustment import DivisibleMap
from gsba.bundle.optimizer import OptimizeResult, SolverOptions
from gsba.memory import give_back_freed_memory, total_memory_bytes
from gsba.parts.divided_system import divided_covariances, optimize_divided
from gsba.parts.folder import At, PartsWriter, has_index, keys_beside, load, remove_map, serialized
from gsba.parts.observations import NotStorableError, TermRows
from gsba.store.records import save_record
from gsba.store.shards import Workers, content_digest
from gsba.types import Iteration, JointErrors
from gsba.version import __version__

logger = logging.getLogger(__name__)

_MEMORY_SHARE = 4  # of the machine's memory, beyond which an adjustment is divided
_FRAMES = 1000  # of a part, where nothing else is asked for
_MAX_CUT_SHARE = 0.5  # of all frames; where more are on cuts, parts have little of their own
_FACTORS_AT_ONCE = 10_000  # of the graph, written together


@dataclass(frozen=True, slots=True)
class _Finished:
    """An adjustment that was solved, for a call that goes on."""

    at: At
    history: tuple[Iteration, ...]
    converged: bool
    reason: str


@dataclass(frozen=True)
class DividedAdjustments:
    """Adjusts the maps of a run in parts: a `gsba.bundle.adjustment.Division`."""

    folder: Path  # of the maps that are being adjusted, emptied when their stage is stored
    scratch: Path  # of the workers' own files
    workers: Workers
    part_frames: int | None  # frames of a part; None = by memory
    told: set[str] = field(default_factory=set)  # reasons that were logged

    def minimized(self, map_: DivisibleMap, options: SolverOptions) -> OptimizeResult | None:
        """See `gsba.bundle.adjustment.Division`.

        A call that goes on has what earlier ones solved, and goes on within what they had begun.
        """
        most = self._frames_of_parts(map_)
        if most is None:
            return None
        name = self._digest(map_, most, repr(options))
        if name is None:
            return None
        folder, finished = self.folder / name, self.folder / f"{name}.npz"
        if finished.exists():
            stored = load(finished, _Finished)
            values = stored.at.values(range(map_.num_frames))
            result = OptimizeResult(values, stored.history, stored.converged, stored.reason)
        elif self._written(folder, map_, most):
            result = optimize_divided(folder, self.workers, options, self.scratch)
            at = At.of(result.values, range(map_.num_frames), keys_beside(result.values))
            stored = _Finished(at, result.history, result.converged, result.reason)
            save_record(finished, stored, {})
        else:
            return None
        remove_map(folder)
        values = gtsam.Values(map_.values)
        values.update(result.values)
        return OptimizeResult(values, result.history, result.converged, result.reason)

    def covariances(
        self, map_: DivisibleMap, num_draws: int, seed: int
    ) -> tuple[np.ndarray, JointErrors] | None:
        """See `gsba.bundle.adjustment.Division`."""
        most = self._frames_of_parts(map_)
        if most is None:
            return None
        name = self._digest(map_, most, "covariances")
        if name is None or not self._written(self.folder / name, map_, most, joint=True):
            return None
        how = self.workers, map_.loss, num_draws, seed, self.scratch
        found = divided_covariances(self.folder / name, *how)
        remove_map(self.folder / name)
        return found

    def _frames_of_parts(self, map_: DivisibleMap) -> int | None:
        """Frames of a part at most; None = the map is not divided."""
        if self.part_frames is not None:
            return self.part_frames if map_.num_frames > self.part_frames else None
        # bytes of an observation in an undivided adjustment, about
        needed = _MEMORY_SHARE * 400 * map_.num_observations
        big = needed > total_memory_bytes() and map_.num_frames > _FRAMES
        return _FRAMES if big else None

    def _digest(self, map_: DivisibleMap, most: int, purpose: str) -> str | None:
        """Name of a map's folder by all that its solution depends on; None = not storable."""
        parts = [__version__, purpose, most, map_.num_frames, map_.loss]
        frames = range(map_.num_frames)
        parts.append(content_digest(At.of(map_.values, frames, keys_beside(map_.values))))
        try:
            for graph in _pieces(map_.graph):
                parts.append(content_digest(serialized(graph)))
            for points_world, terms in map_.chunks():
                parts.append(content_digest(points_world, *map(TermRows.of, terms)))
        except NotStorableError as error:
            self._tell(str(error))
            return None
        return content_digest(*parts)[:24]

    def _written(self, folder: Path, map_: DivisibleMap, most: int, joint: bool = False) -> bool:
        """Write the parts of a map; False where there would be no gain."""
        if has_index(folder):
            return True
        num = map_.num_frames
        remove_map(folder)  # what an interrupted call left of it
        writer = PartsWriter(folder)
        if joint:
            writer.tie(np.column_stack([np.arange(num - 1), np.arange(1, num)]))
        for graph in _pieces(map_.graph):
            writer.add(np.empty((0, 3)), (), graph)
        for points_world, terms in map_.chunks():
            writer.add(points_world, terms)
        cut = writer.cut(map_.values, num, most)
        on_cuts = int(np.count_nonzero(cut.on_cut[:num]))
        if on_cuts > _MAX_CUT_SHARE * num:
            remove_map(folder)
            self._tell("more than half of the frames would lie on the cuts")
            return False
        writer.finish(map_.values, num, cut)
        give_back_freed_memory()  # of writing, beside what solving takes
        logger.debug("%d frames in %d parts, %d on cuts", num, cut.num_parts, on_cuts)
        return True

    def _tell(self, reason: str) -> None:
        """Log, once a run, why a map is adjusted undivided."""
        if reason not in self.told:
            logger.info("adjusted undivided, not in parts: %s", reason)
            self.told.add(reason)


def _pieces(graph: gtsam.NonlinearFactorGraph) -> list[gtsam.NonlinearFactorGraph]:
    pieces = []
    for first in range(0, graph.size(), _FACTORS_AT_ONCE):
        piece = gtsam.NonlinearFactorGraph()
        for i in range(first, min(first + _FACTORS_AT_ONCE, graph.size())):
            piece.push_back(graph.at(i))
        pieces.append(piece)
    return pieces
