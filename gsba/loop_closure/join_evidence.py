"""What speaks for a join of two parts of a map, and what speaks against it.

If a join is true, a point that one part knows shows in frames of the other part that stand close by
and know a surface where the point must appear. A poster, a window or an arch that repeats brings
matches for a false join, but not the rest of the place. So points that are found again are weighed
against those that are not, by how often points are found again within parts under the same change
of view. Points of a small cell of space are one witness, and witnesses of one region err together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from gsba.geometry import inverse
from gsba.matching.guided_search import Gate, MatchContext
from gsba.types import Matches

LOCAL = 12  # frames to either side of a meeting, which are asked what speaks for and against it
WIDER = 36  # the same where these leave it open
_REACH = 2.0  # local depths between two frames that are compared
_NEAREST = 3  # frames that each frame is compared with
_MOST_PAIRS = 150
_MADE_BY = 2  # frames apart: points are made from matches of frames as close as that
_GATE = np.deg2rad(4.0)  # around the direction in which a point must appear
_SURFACE = 2 * np.sin(np.deg2rad(6.0) / 2)  # chord around it, in which a frame must know a surface
_SURFACE_POINTS = 3  # of those a frame knows, the nearest to the direction
_SAME_SURFACE = 1.25  # ratio of the distances of a surface and of a point on it
_ANGLES = np.deg2rad([6.0, 12.0, 20.0, 30.0, 45.0])  # edges of bins of the angle between two views
_RATIOS = np.log([1.15, 1.35, 1.7])  # edges of bins of the ratio of distances
_BINS = (len(_ANGLES) + 1) * (len(_RATIOS) + 1)
_PSEUDO = 20.0  # points that each bin starts with, found at the rate of all bins
_TYPICAL = 0.3  # rate where no two frames of one part can be compared
_AWAY = 2.0  # rad about the vertical: predictions turned by that are met by chance only
_CELL, _REGION = 0.25, 1.0  # edges of cells of space, median depths
_UNSEEN_REGIONS = 1.0  # regions with nothing found that are added to those there are; and as many
# with all found
_LOOK_ALIKE = 0.3  # share of what should be found again that a look-alike brings: as much as a hall
# of repeated arches one arch further on
_SIGMAS = 3.09  # a one-sided error rate of 1e-3
_ABSENT = 0.1  # share that is as good as nothing found


@dataclass(frozen=True, slots=True)
class Places:
    """Frames of one or of several parts of a map, and the points they know.

    Each part is in units of its own, or all are in those of one map.
    """

    world_T_rigs: np.ndarray  # (F, 4, 4) float64
    known: Sequence[np.ndarray]  # (F) of (K_f, 3): points of the keypoints of each frame, in its
    # rig frame, NaN where unknown

    def depths(self) -> np.ndarray:
        """Median distances (F,) of the points that frames know; NaN where there are none."""
        lengths = [np.linalg.norm(points, axis=1) for points in self.known]
        known = [length[np.isfinite(length)] for length in lengths]
        return np.array([np.median(some) if len(some) else np.nan for some in known])


@dataclass(frozen=True, slots=True)
class Predictions:
    """Points that one frame knows, where another frame must show them."""

    points_world: np.ndarray  # (V, 3) float64
    bins: np.ndarray  # (V,) int64, of the change of view
    found: np.ndarray  # (V,) bool: a keypoint there matches


@dataclass(frozen=True, slots=True)
class Rates:
    """How often predicted points are found."""

    within: np.ndarray  # (B,) float64, within parts, by change of view
    chance: float  # where predictions are turned away


@dataclass(frozen=True, slots=True)
class JoinEvidence:
    """What the surroundings say of a join."""

    share: float  # of what a true join lets find again: 1 = as much as within parts, 0 = no more
    # than by chance
    sigma: float  # infinite: nothing is predicted
    witnesses: int  # cells of space whose points are predicted

    def __str__(self) -> str:
        if not self.witnesses:
            return "no frames of both stand where they see the same"
        return (
            f"{100 * self.share:.0f} % (sigma {100 * self.sigma:.0f} %) of what frames of both "
            f"should show is found again; look-alikes bring {100 * _LOOK_ALIKE:.0f} %"
        )

    @property
    def least(self) -> float:
        """The share that surely is found again."""
        return self.share - _SIGMAS * self.sigma

    @property
    def confirmed(self) -> bool:
        """Whether surely more is found again than a look-alike brings."""
        return self.least > _LOOK_ALIKE

    @property
    def refuted(self) -> bool:
        """Whether surely less is found again than a true join brings."""
        return self.share + _SIGMAS * self.sigma < _LOOK_ALIKE

    @property
    def decided(self) -> bool:
        """Whether the join is confirmed or refuted."""
        return self.confirmed or self.refuted

    @property
    def absent(self) -> bool:
        """Whether surely next to nothing is found again."""
        return self.share + _SIGMAS * self.sigma < _ABSENT

    def beats(self, other: "JoinEvidence") -> bool:
        """Whether this join is surely the better one of two."""
        return self.share - other.share > _SIGMAS * float(np.hypot(self.sigma, other.sigma))


def rates(context: MatchContext, places: Places, parts: np.ndarray, surfaces: bool = True) -> Rates:
    """How often points of a frame are found again in frames of its own part.

    Args:
        context: of the run.
        places: frames and points, each part right in itself.
        parts: (F,) int, part of each frame.
        surfaces: see `predict`.
    """
    rows = [np.flatnonzero(parts == p) for p in np.unique(parts)]
    pairs = np.concatenate([nearest_pairs(places, some, some) for some in rows])
    pairs = pairs[np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_PAIRS)).astype(int)]
    seen = predict(context, places, pairs, surfaces)[0]
    numbers, hits = (np.bincount(seen.bins, w, _BINS) for w in (None, seen.found))
    mean = (hits.sum() + _PSEUDO * _TYPICAL) / (numbers.sum() + _PSEUDO)
    within = (hits + _PSEUDO * mean) / (numbers + _PSEUDO)
    poses, odd = places.world_T_rigs.copy(), np.arange(len(parts)) % 2 == 1
    cosine, sine = np.cos(_AWAY), np.sin(_AWAY)
    poses[odd, :3, :3] = poses[odd, :3, :3] @ [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    turned = pairs[odd[pairs[:, 0]] != odd[pairs[:, 1]]]
    away = predict(context, replace(places, world_T_rigs=poses), turned, surfaces)[0]
    return Rates(within, float(away.found.mean()) if len(away.found) else 0.0)


def weigh(
    context: MatchContext,
    places: Places,
    groups: tuple[np.ndarray, np.ndarray],
    usual: Rates,
    depth: float,
    surfaces: bool = True,
) -> tuple[JoinEvidence, Matches]:
    """Weigh what speaks for and against a join of two groups of frames.

    Args:
        context: of the run.
        places: frames and points of both groups, as the join has them.
        groups: (N,) and (M,) frames.
        usual: of `rates`, with the same `surfaces`.
        depth: median distance of points, map units.
        surfaces: see `predict`.

    Returns:
        The evidence, and what was found again: matches of frames of both groups.
    """
    pairs = nearest_pairs(places, *groups)[:_MOST_PAIRS]
    seen, found = predict(context, places, pairs, surfaces)
    if not len(seen.found):
        return JoinEvidence(0.0, np.inf, 0), found
    cells = np.floor(seen.points_world / (_CELL * depth)).astype(np.int64)
    cells, cell_of = np.unique(cells, axis=0, return_inverse=True)
    numbers = np.bincount(cell_of)
    excess = np.bincount(cell_of, seen.found - usual.chance) / numbers
    expected = np.bincount(cell_of, usual.within[seen.bins] - usual.chance) / numbers
    regions = np.floor(cells * (_CELL / _REGION)).astype(np.int64)
    region_of = np.unique(regions, axis=0, return_inverse=True)[1]
    excess, expected = np.bincount(region_of, excess), np.bincount(region_of, expected)
    unseen = _UNSEEN_REGIONS * float(expected.mean())
    total = float(expected.sum()) + 2 * unseen
    share = (float(excess.sum()) + unseen) / total
    squares = float(np.sum((excess - share * expected) ** 2))
    squares += unseen**2 * (share**2 + (1 - share) ** 2)
    return JoinEvidence(share, float(np.sqrt(squares)) / total, len(cells)), found


def around(frames: np.ndarray, middle: int, reach: int = LOCAL) -> np.ndarray:
    """Frames (N,), ascending, at most `reach` before or after one of them: drift is small there."""
    place = int(np.searchsorted(frames, middle))
    return frames[max(place - reach, 0) : place + reach + 1]


def nearest_pairs(places: Places, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) int32 of frames of two groups that stand close to one another, the closest
    first, in both orders. Within one group, pairs whose matches make points are left out."""
    positions, depths = places.world_T_rigs[:, :3, 3], places.depths()
    found = set[tuple[int, int]]()
    for some, others in ((one, other), (other, one)):
        for f in some.tolist():
            apart = others[np.abs(others - f) > _MADE_BY] if some is others else others
            distances = np.linalg.norm(positions[apart] - positions[f], axis=1)
            close = np.flatnonzero(distances < _REACH * np.fmin(depths[apart], depths[f]))
            nearest = close[np.argsort(distances[close], kind="stable")][:_NEAREST]
            found |= {pair for g in apart[nearest].tolist() for pair in ((f, g), (g, f))}
    pairs = np.array(sorted(found), np.int32).reshape(-1, 2)
    lengths = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    return pairs[np.argsort(lengths, kind="stable")]


def predict(
    context: MatchContext, places: Places, pairs: np.ndarray, surfaces: bool
) -> tuple[Predictions, Matches]:
    """Where second frames of pairs must show points that the first frames know.

    Args:
        context: of the run.
        places: frames and points.
        pairs: (P, 2) frames.
        surfaces: only points on surfaces that the second frame knows; else all, though some will
            be occluded.

    Returns:
        Predictions, and the matches that were found.
    """
    gates = [Gate.around_points(_GATE)] * len(pairs)
    found = context.match(pairs, places.world_T_rigs, gates, places.known, guided_only=True)
    parts = [_predicted(places, f, g, found.of(p), surfaces) for p, (f, g) in enumerate(pairs)]
    points, bins, hits = (
        np.concatenate([empty, *(part[n] for part in parts)])
        for n, empty in enumerate((np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, bool)))
    )
    return Predictions(points, bins, hits), found


def _predicted(
    places: Places, f: int, g: int, matched: np.ndarray, surfaces: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one pair: points (V, 3) in the world, bins (V,) of their change of view, found (V,)."""
    rows = np.flatnonzero(np.isfinite(places.known[f]).all(axis=1))
    own, g_T_f = places.known[f][rows], inverse(places.world_T_rigs[g]) @ places.world_T_rigs[f]
    there = own @ g_T_f[:3, :3].T + g_T_f[:3, 3]
    distances = np.linalg.norm(there, axis=1)
    if surfaces:
        on = _on_surface(places.known[g], there / distances[:, None], distances)
        rows, own, there, distances = rows[on], own[on], there[on], distances[on]
    before = np.linalg.norm(own, axis=1)
    cosines = np.sum((own @ g_T_f[:3, :3].T) * there, axis=1) / (before * distances)
    angles = np.digitize(np.arccos(np.clip(cosines, -1, 1)), _ANGLES)
    ratios = np.digitize(np.abs(np.log(before / distances)), _RATIOS)
    world_T_f = places.world_T_rigs[f]
    points = own @ world_T_f[:3, :3].T + world_T_f[:3, 3]
    return points, angles * (len(_RATIOS) + 1) + ratios, np.isin(rows, matched[:, 0])


def _on_surface(known: np.ndarray, directions: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Which points, at distances (V,) along unit directions (V, 3), lie on surfaces (V,) bool that
    a frame's points (K, 3) show."""
    points = known[np.isfinite(known).all(axis=1)]
    if not len(points):
        return np.zeros(len(distances), bool)
    lengths = np.linalg.norm(points, axis=1)
    tree = KDTree(points / lengths[:, None])
    chords, nearest = tree.query(directions, _SURFACE_POINTS, distance_upper_bound=_SURFACE)
    around = np.append(lengths, np.inf)[nearest].min(axis=1)
    known_there = np.isfinite(chords[:, 0])
    return known_there & (np.abs(np.log(around / distances)) < np.log(_SAME_SURFACE))
