"""Observations of landmarks as arrays, which any family of `factors` gives and files hold."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from factors import Term
from gsba.log import GsbaError


class NotStorableError(GsbaError):
    """A factor or a residual that files cannot hold, as it is written in Python."""


@dataclass(frozen=True, slots=True)
class TermRows:
    """Observations of one family: implements the terms that `factors.LandmarkBlock` takes."""

    name: str  # family that the cost is reported under
    kind: int  # of measurement: bearing or reprojection
    frames: np.ndarray  # (O,) int32, row of the poses
    points: np.ndarray  # (O,) int32, row of the landmarks
    measured: np.ndarray  # (O, 3) float64, rows of `measurements`
    roots: np.ndarray  # (O, 3) float64, rows of `whiteners`
    faces: np.ndarray  # (C, 12) float64, rows of `cameras`
    origins_rig: np.ndarray | None  # (O, 3) float64, map units; None = the rig's own centre

    @classmethod
    def of(cls, term: Term) -> "TermRows":
        """The arrays of a term of `factors`; NotStorableError if its residual is a function."""
        if not isinstance(term.kind, int):
            raise NotStorableError(
                f"the residual of family {term.name} is a function, which files cannot hold"
            )
        origins = None if term.origins_rig is None else np.asarray(term.origins_rig, np.float64)
        return cls(
            term.name,
            term.kind,
            np.asarray(term.frames, np.int32),
            np.asarray(term.points, np.int32),
            np.asarray(term.measurements(), np.float64),
            np.asarray(term.whiteners(), np.float64),
            np.asarray(term.cameras(), np.float64),
            origins,
        )

    def measurements(self) -> np.ndarray:
        """(O, 3) rows as the kernels read them."""
        return self.measured

    def whiteners(self) -> np.ndarray:
        """(O, 3) upper triangles of the square-root information."""
        return self.roots

    def cameras(self) -> np.ndarray:
        """(C, 12) rows of the face cameras."""
        return self.faces

    def taken(self, chosen: np.ndarray, points: np.ndarray) -> "TermRows":
        """The chosen observations, (O,) bool, their landmarks renumbered by `points (J,)`."""
        return replace(
            self,
            frames=self.frames[chosen],
            points=points[self.points[chosen]].astype(np.int32),
            measured=self.measured[chosen],
            roots=self.roots[chosen],
            origins_rig=None if self.origins_rig is None else self.origins_rig[chosen],
        )


@dataclass(frozen=True, slots=True)
class ObservedRows:
    """Landmarks, each with all of its observations."""

    terms: tuple[TermRows, ...]
    points_world: np.ndarray  # (J, 3) float64, start

    @property
    def frames(self) -> np.ndarray:
        """(O,) int32, frame of each observation, term after term."""
        return np.concatenate([np.empty(0, np.int32), *(term.frames for term in self.terms)])

    @property
    def points(self) -> np.ndarray:
        """(O,) int32, row of the landmark of each."""
        return np.concatenate([np.empty(0, np.int32), *(term.points for term in self.terms)])

    def taken(self, mine: np.ndarray) -> "ObservedRows":
        """The landmarks `mine`, (J,) bool."""
        points = np.cumsum(mine) - 1
        terms = tuple(term.taken(mine[term.points], points) for term in self.terms)
        return ObservedRows(terms, self.points_world[mine])


def merged(chunks: Sequence[ObservedRows], local: np.ndarray) -> ObservedRows:
    """Sightings one behind the other, frames replaced by `local (F,)` ones."""
    firsts = np.cumsum([0, *(len(chunk.points_world) for chunk in chunks)])
    groups: dict[tuple[str, int, bytes], list[TermRows]] = {}
    for chunk, first in zip(chunks, firsts, strict=False):
        for term in chunk.terms:
            moved = replace(term, frames=local[term.frames], points=term.points + np.int32(first))
            groups.setdefault((term.name, term.kind, term.faces.tobytes()), []).append(moved)
    points = [np.empty((0, 3)), *(chunk.points_world for chunk in chunks)]
    return ObservedRows(tuple(_joined(group) for group in groups.values()), np.concatenate(points))


def _joined(terms: Sequence[TermRows]) -> TermRows:
    origins = None
    if any(term.origins_rig is not None for term in terms):
        none = [np.zeros((len(term.frames), 3)) for term in terms]
        given = [term.origins_rig for term in terms]
        origins = np.concatenate([n if o is None else o for n, o in zip(none, given, strict=True)])
    return replace(
        terms[0],
        frames=np.concatenate([term.frames for term in terms]).astype(np.int32),
        points=np.concatenate([term.points for term in terms]).astype(np.int32),
        measured=np.concatenate([term.measured for term in terms]),
        roots=np.concatenate([term.roots for term in terms]),
        origins_rig=origins,
    )
