"""Maps of a tour, joined across a step that no three frames confirm, as through a door.

Frames on both sides see little in common, but their maps have points of known depth. Of each
hypothesis of the step, points of either map are searched in frames of the other along epipolar
lines; the depths found give the step's length in units of both maps. Pose and lengths are fitted
to places found by all frames near the step, and a join is believed if many more cells of the
sphere confirm it than any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsba.camera.rig import cells_of
from gsba.geometry import angles_between, inverse, pose, unit
from gsba.odometry.tour_steps import (
    CELLS_PER_SIDE,
    MAX_ALIKE_LOG,
    MAX_OFF_RAD,
    MIN_PARALLAX_RAD,
    TourFrame,
    agreed_logs,
    alike_poses,
    fits,
    found_places,
    rough_poses,
)

_NUM_VOTERS = 300  # keys of a frame that propose lengths
_LENGTH_WIDTH, _NUM_LENGTHS = 0.15, 2  # of a length's logarithm, within which keys agree; tried
_MAX_LOG_SCALE = np.log(8.0)  # of the units of two maps, whose first steps they are
_NUM_STARTS, _NUM_FINAL = 12, 3  # hypotheses that are fitted to two frames; to all near the step
NEAR = 3  # frames of either map beside the step
MIN_SCORE, MIN_LEAD = 16.0, 1.7  # that confirm a join; times that of any rival


@dataclass(frozen=True, slots=True)
class TourMap:
    """Confirmed steps in a row, or a single frame, of whose keys no depth is known."""

    first: int  # frame
    f_T_firsts: np.ndarray  # (F, 4, 4) of its frames; the first step has length 1
    depths: list[np.ndarray]  # (N,) of the keys of each frame, map units; NaN = not known

    @property
    def single(self) -> bool:
        return len(self.f_T_firsts) == 1

    @property
    def last(self) -> int:
        return self.first + len(self.f_T_firsts) - 1

    def part(self, first: int, last: int) -> "TourMap":
        """The map of some of its frames, in the same units."""
        rows = slice(first - self.first, last - self.first + 1)
        poses = self.f_T_firsts[rows]
        return TourMap(first, poses @ inverse(poses[0]), self.depths[rows])

    def between(self, f: int, g: int) -> np.ndarray:
        """Pose g_T_f (4, 4)."""
        return self.f_T_firsts[g - self.first] @ inverse(self.f_T_firsts[f - self.first])


@dataclass(frozen=True, slots=True)
class Places:
    """Keys of a frame found in a frame of the other map."""

    f: int  # whose keys are searched
    g: int
    rows: np.ndarray  # (M,) keys
    rays: np.ndarray  # (M, 3) of them
    depths: np.ndarray  # (M,) units of their map
    found: np.ndarray  # (M, 3) rays in the other frame
    sound: np.ndarray  # (M,) bool


@dataclass(frozen=True, slots=True)
class Join:
    """A similarity between two maps, and what confirms it."""

    g_T_f: np.ndarray  # (4, 4) first frame of the second map from the last of the first, its units
    log_scale: float  # logarithm of a unit of the second map, units of the first
    score: float  # mean of the cells in which most places confirm it, of all and of sound keys
    places: list[Places]


def join(frames: Sequence[TourFrame], one: TourMap, other: TourMap) -> tuple[Join | None, float]:
    """The join of a map and the one that follows it which most places confirm, and the score of
    its best rival."""
    f, g = one.last, other.first
    joining = Joining(frames, one, other)
    starts = list[tuple[int, Join]]()
    for _, g_T_f in rough_poses(frames[f], frames[g]):
        starts += joining.starts(g_T_f)
    starts.sort(key=lambda start: -start[0])
    found = list[Join]()
    for _, start in starts[:_NUM_STARTS]:
        rough = joining.fitted(start, [(f, g)], 1.4, 4.0, True)
        found.append(joining.fitted(rough, [(f, g)], 0.7, 2.0))
    near = [
        list(product(range(max(f - n, one.first), f + 1), range(g, min(g + n, other.last) + 1)))
        for n in range(NEAR)
    ]
    final = list[Join]()
    for rough in _distinct(found)[:_NUM_FINAL]:
        better = joining.fitted(rough, near[1], 0.7, 1.5)
        final.append(joining.fitted(better, near[-1], 0.35, 0.8))
    if final and not (one.single or other.single):  # few places hold a scale: others are near
        best = max(final, key=lambda some: some.score)
        for log in (-0.2, -0.1, 0.1, 0.2):  # of the best join, added to its logarithm
            final.append(
                joining.fitted(replace(best, log_scale=best.log_scale + log), near[-1], 0.35, 0.8)
            )
    ranked = _distinct(final)
    return next(iter(ranked), None), ranked[1].score if len(ranked) > 1 else 0.0


def is_sure(best: Join | None, rival: float) -> bool:
    """True if places confirm a join clearly, and no rival nearly as well."""
    return best is not None and best.score >= max(MIN_SCORE, MIN_LEAD * rival)


@dataclass(frozen=True, slots=True)
class Joining:
    """Two maps whose join is searched."""

    frames: Sequence[TourFrame]
    one: TourMap
    other: TourMap

    def starts(self, g_T_f: np.ndarray) -> list[tuple[int, Join]]:
        """Joins, and the cells that propose them, by lengths of a step of unit length on which
        points of either map agree."""
        f, g = self.one.last, self.other.first
        before = self._lengths(f, g, self.one.depths[-1], g_T_f)
        after = self._lengths(g, f, self.other.depths[0], inverse(g_T_f))
        # A single frame has the units of the other map.
        if self.one.single or self.other.single:
            lengths = [(log, log, cells) for log, cells in [*before, *after]]
        else:
            lengths = [
                (log0, log1, cells0 + cells1)
                for (log0, cells0), (log1, cells1) in product(before, after)
                if abs(log0 - log1) < _MAX_LOG_SCALE
            ]
        return [
            (cells, Join(scaled(g_T_f, np.exp(log0)), log0 - log1, 0.0, []))
            for log0, log1, cells in lengths
        ]

    def _lengths(
        self, f: int, g: int, depths: np.ndarray, g_T_f: np.ndarray
    ) -> list[tuple[float, int]]:
        """Logarithms of lengths of a step in units of depths (N,), and cells that agree."""
        frame, known = self.frames[f], np.flatnonzero(np.isfinite(depths))
        known = known[np.argsort(~frame.sound[known], kind="stable")]
        half = _NUM_VOTERS // 2  # of sound keys first, then of others
        rows = np.unique(np.append(known[:half], known[::-1][:half]))
        rows, found = found_places(frame, self.frames[g], rows, g_T_f, 2.8, True)
        good, parallax, steps = fits(frame.keys[rows], found, g_T_f, 2.0)
        good &= parallax > MIN_PARALLAX_RAD
        logs = np.log(depths[rows[good]] / steps[good])
        cells = cells_of(frame.keys[rows[good]], CELLS_PER_SIDE)
        return agreed_logs(logs, cells, _LENGTH_WIDTH, _NUM_LENGTHS)

    def between(self, at: Join, f: int, g: int) -> np.ndarray:
        """Pose g_T_f (4, 4) of frames of different maps, units of the map of f."""
        if f > self.one.last:
            g_T_f = inverse(self.between(at, g, f))
            return scaled(g_T_f, np.exp(-at.log_scale))
        after = scaled(self.other.between(self.other.first, g), np.exp(at.log_scale))
        return after @ at.g_T_f @ self.one.between(f, self.one.last)

    def fitted(
        self,
        at: Join,
        pairs: Sequence[tuple[int, int]],
        beside_deg: float,
        gate_deg: float,
        coarse: bool = False,
    ) -> Join:
        """A join fitted to the places found along its epipolar lines."""
        places = list[Places]()
        for f, g in [*pairs, *((g, f) for f, g in pairs)]:
            of = self.one if f <= self.one.last else self.other
            depths = of.depths[f - of.first]
            rows, g_T_f = np.flatnonzero(np.isfinite(depths)), self.between(at, f, g)
            length = float(np.linalg.norm(g_T_f[:3, 3]))
            if not len(rows) or not length > 0:
                continue
            frame, along = self.frames[f], scaled(g_T_f, 1 / length)
            rows, found = found_places(frame, self.frames[g], rows, along, beside_deg, coarse)
            if len(rows):
                keys, sound = frame.keys[rows], frame.sound[rows]
                places.append(Places(f, g, rows, keys, depths[rows], found, sound))
        at = self._adjusted(at, places, np.deg2rad(gate_deg))
        return Join(at.g_T_f, at.log_scale, self._score(at, places), places)

    def _predicted(self, at: Join, some: Places) -> np.ndarray:
        g_T_f = self.between(at, some.f, some.g)
        return unit((some.rays * some.depths[:, None]) @ g_T_f[:3, :3].T + g_T_f[:3, 3])

    def _adjusted(self, at: Join, places: Sequence[Places], gate_rad: float) -> Join:
        """Pose and scale by least squares of the places within a gate, Cauchy's loss."""
        near = [angles_between(self._predicted(at, some), some.found) < gate_rad for some in places]
        if sum(map(np.count_nonzero, near)) < 6:  # places that a join is fitted to
            return at
        length = float(np.linalg.norm(at.g_T_f[:3, 3]))
        num = 6 if self.one.single or self.other.single else 7  # a single frame has no scale

        def moved(by: np.ndarray) -> Join:
            turn = Rotation.from_rotvec(by[:3]).as_matrix()
            g_T_f = pose(turn @ at.g_T_f[:3, :3], at.g_T_f[:3, 3] + by[3:6] * length)
            return Join(g_T_f, at.log_scale + sum(by[6:]), 0.0, [])

        def residuals(by: np.ndarray) -> np.ndarray:
            other = moved(by)
            off = [
                (self._predicted(other, some) - some.found)[rows].ravel()
                for some, rows in zip(places, near, strict=True)
            ]
            return np.concatenate([*off, 1e-3 * by])  # by: what no place determines stays

        solved = least_squares(
            residuals, np.zeros(num), loss="cauchy", f_scale=gate_rad / 5, max_nfev=20
        )
        return moved(solved.x)

    def confirms(self, at: Join, some: Places) -> np.ndarray:
        """Places (M,) bool that are where a join predicts them, and not where a mere turn does."""
        turned = some.rays @ self.between(at, some.f, some.g)[:3, :3].T
        good = angles_between(self._predicted(at, some), some.found) < MAX_OFF_RAD
        return good & (angles_between(turned, some.found) > MIN_PARALLAX_RAD)

    def _score(self, at: Join, places: Sequence[Places]) -> float:
        cells = np.zeros(2)
        for some in places:
            good = np.where(self.confirms(at, some), 1.0, -1.0)
            where = cells_of(some.rays, CELLS_PER_SIDE)
            for n, weight in enumerate((good, good * some.sound)):
                cells[n] += np.count_nonzero(np.bincount(where, weight) > 0)
        return float(np.sqrt(np.prod(1 + cells)) - 1)


def scaled(g_T_f: np.ndarray, by: float) -> np.ndarray:
    """A pose (4, 4) with a longer translation."""
    return pose(g_T_f[:3, :3], g_T_f[:3, 3] * by)


def _distinct(joins: Sequence[Join]) -> list[Join]:
    """Joins by falling score, without those that are nearly the same as a better one."""
    kept = list[Join]()
    for one in sorted(joins, key=lambda some: -some.score):
        if not any(alike(one, other) for other in kept):
            kept.append(one)
    return kept


def alike(one: Join, other: Join) -> bool:
    """True if two joins of the same maps are nearly the same."""
    longer = np.linalg.norm(one.g_T_f[:3, 3]) / np.linalg.norm(other.g_T_f[:3, 3])
    logs = abs(np.log(longer)), abs(one.log_scale - other.log_scale)
    return alike_poses(one.g_T_f, other.g_T_f) and max(logs) < MAX_ALIKE_LOG
