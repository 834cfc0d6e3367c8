"""Families of residuals beside those of images: one object adds all that a sensor or a plan knows.

A family has factors, and variables of its own if need be: a barometer has heights and a bias, tags
have poses, wheels a scale. It is asked anew whenever the map changes, so that its factors always
belong to the poses that they are solved with.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import gtsam
import numpy as np

from factors import Block
from gsba.bundle.family_variables import kept, restored
from gsba.bundle.prior_factors import X, values_of
from gsba.log import GsbaError
from gsba.types import FamilyVariables, Landmarks, Solution


@dataclass(frozen=True, slots=True)
class MapSnapshot:
    """The map that a family builds its factors from."""

    names: tuple[str, ...]  # (F) of the frames
    timestamps: np.ndarray  # (F,) float64 seconds; 0, 1, 2, ... where frames have no times
    world_T_rigs: np.ndarray  # (F, 4, 4) float64, poses so far, map units
    maps: np.ndarray  # (F,) int64, map of each frame, 0 = the largest: maps have worlds and scales
    # of their own until they are joined
    landmarks: Landmarks  # points so far; none before the first adjustment
    variables: gtsam.Values  # of all families, as the last adjustment left them; empty before it


class Family(Protocol):
    """Residuals of one kind, their variables, and what the report says of them.

    Subclass it; only `name`, `digest` and one of `graph` and `blocks` are needed. Keys of frames
    are `gsba.X(frame)`; keys of own variables are `gtsam.symbol` with a capital letter.
    """

    name: str  # in settings, in the report and in messages
    digest: str  # of all that the family depends on: results are resumed while it stays the same
    fixes_gauge: bool = False  # it knows the scale, or the world: the result stays where it says

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """Own variables with the values to start from."""
        return gtsam.Values()

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """Few factors, on frames' poses and own variables of any type."""
        return gtsam.NonlinearFactorGraph()

    def blocks(self, snapshot: MapSnapshot) -> Sequence[Block]:
        """Many residuals held as arrays, see `factors.Block`."""
        return ()

    def report(self, snapshot: MapSnapshot) -> Mapping[str, Any]:
        """The family's part of report.json, under `families.NAME`: JSON values of the final map."""
        return {}


@dataclass(frozen=True, slots=True)
class FamilyTerms:
    """Factors, blocks and variables that families add to an adjustment."""

    graph: gtsam.NonlinearFactorGraph
    blocks: tuple[Block, ...]
    values: gtsam.Values  # own variables to start from

    def variables(self, values: gtsam.Values) -> FamilyVariables | None:
        """Own variables as an adjustment left them; None where there are none."""
        keys = list(self.values.keys())
        return kept(values, keys) if keys else None


@dataclass(frozen=True, slots=True)
class Families:
    """The families of a run, and the frames that they are told of."""

    members: tuple[Family, ...] = ()
    names: tuple[str, ...] = ()  # (F) of the frames
    timestamps: np.ndarray = field(default_factory=lambda: np.zeros(0))  # (F,) float64 seconds

    def __post_init__(self) -> None:
        names = [family.name for family in self.members]
        for name in {name for name in names if names.count(name) > 1}:
            raise GsbaError(f"family {name} is there twice: names are what reports tell apart by")

    @property
    def fixing_gauge(self) -> "Families":
        """Those that know scale or world."""
        members = tuple(family for family in self.members if family.fixes_gauge)
        return Families(members, self.names, self.timestamps)

    def digests(self) -> list[tuple[str, str]]:
        """Names and digests of the families, on which results rest."""
        return [(family.name, family.digest) for family in self.members]

    def snapshot(self, solved: Solution, maps: np.ndarray | None = None) -> MapSnapshot:
        """A solution as families see it.

        Args:
            solved: poses, points, and own variables so far.
            maps: (F,) map of each frame; None = there is one.
        """
        of_frames = numbered(maps, len(solved.world_T_rigs))
        variables = restored(solved.variables)
        given = self.names, self.timestamps, solved.world_T_rigs, of_frames
        return MapSnapshot(*given, solved.landmarks, variables)

    def terms(self, solved: Solution, maps: np.ndarray | None = None) -> FamilyTerms:
        """Factors, blocks and variables of all families, for an adjustment from a solution.

        Raises:
            GsbaError: a factor on a variable that has no value, or a variable that two families
                have, or whose key is not a family's.
        """
        graph, blocks, values = gtsam.NonlinearFactorGraph(), list[Block](), gtsam.Values()
        if not self.members:
            return FamilyTerms(graph, (), values)
        snapshot, frames = self.snapshot(solved, maps), len(solved.world_T_rigs)
        poses = {X(f) for f in range(frames)}
        for family in self.members:
            own = family.variables(snapshot)
            _check_keys(family, own, values)
            known = poses | set(own.keys())
            factors, arrays = family.graph(snapshot), tuple(family.blocks(snapshot))
            for n in range(factors.size()):
                _check_known(family, f"factor {n}", factors.at(n).keys(), known)
            for block in arrays:
                _check_known(family, "a block", block.keys, known)
            values.insert(own)
            graph.push_back(factors)
            blocks += arrays
        start = values_of(solved.world_T_rigs)
        start.insert(values)
        for block in blocks:
            block.refresh(start)
        return FamilyTerms(graph, tuple(blocks), values)


def numbered(maps: np.ndarray | None, num_frames: int) -> np.ndarray:
    """Map (F,) int64 of each frame; None = there is one, map 0."""
    return np.zeros(num_frames, np.int64) if maps is None else np.asarray(maps, np.int64)


def _check_keys(family: Family, own: gtsam.Values, others: gtsam.Values) -> None:
    """GsbaError where a key of a family's variables is not its own."""
    for key in own.keys():  # noqa: SIM118
        shown = gtsam.DefaultKeyFormatter(key)
        if not chr(gtsam.symbolChr(key)).isupper():
            raise GsbaError(
                f"family {family.name}: variable {shown}: make its key by gtsam.symbol with a "
                "capital letter, others are gsba's own"
            )
        if others.exists(key):
            raise GsbaError(
                f"family {family.name}: variable {shown} belongs to another family: choose "
                "another letter"
            )


def _check_known(family: Family, what: str, keys: Iterable[int], known: set[int]) -> None:
    """GsbaError where a residual is about a variable that has no value."""
    for key in keys:
        if key not in known:
            raise GsbaError(
                f"family {family.name}: {what} is about variable "
                f"{gtsam.DefaultKeyFormatter(key)}, which has no value: there is no such frame, "
                "and variables() does not return it"
            )
