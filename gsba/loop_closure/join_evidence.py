"""Evidence for and against a join of two parts of a map (see docs/method.md).

Points that are found again are weighed against those that are not, relative to the rate within
parts under the same change of view; how near a point is to its place counts, too. Points of a small
cell of space are one witness, and witnesses of one region have correlated errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from gsba.geometry import angles_between, inverse
from gsba.matching.guided_search import Gate, MatchContext
from gsba.significance import SIGMAS_OF_1E_3
from gsba.types import Matches, rows_across

LOCAL = 12  # frames to either side of a meeting that are compared
WIDER = 36  # frames to either side if the LOCAL ones leave it open
_NUM_NEAREST = 3  # nearest frames that each frame is compared with
_MAX_PAIRS = 150  # largest number of compared pairs of frames
GATE_RAD = np.deg2rad(4.0)  # radius around a point's predicted bearing
_PLACE_RAD = np.deg2rad(0.7)  # radius in which most true matches lie; chance, and things that only
# stand at similar places, spread them over the gate
_BESIDE = -(_PLACE_RAD**2) / (GATE_RAD**2 - _PLACE_RAD**2)  # worth of a match outside this radius:
# matches by chance cancel
# Edges of bins of the angle between two views.
_ANGLE_EDGES_RAD = np.deg2rad([6.0, 12.0, 20.0, 30.0, 45.0])
_LOG_RATIO_EDGES = np.log([1.15, 1.35, 1.7])  # edges of bins of the ratio of distances
_NUM_BINS = (len(_ANGLE_EDGES_RAD) + 1) * (len(_LOG_RATIO_EDGES) + 1)
_PRIOR_COUNT = 20.0  # prior count of points in each bin, found at the mean rate of all bins
# Rotation about the vertical after which predictions are found by chance only.
_CHANCE_ROTATION_RAD = 2.0
_CELL_DEPTHS, _REGION_DEPTHS = 0.25, 1.0  # edges of cells of space, median depths
# Share found again at a look-alike: as much as in a hall of repeated arches, one arch further on.
_LOOK_ALIKE_SHARE = 0.3
# Share found at its place, above what two homes of one plan with furniture at the same places have:
# at most 30 % in rendered pairs. Homes filmed twice: 101 %, in another light 68 to 84 %.
_LOOK_ALIKE_PLACED = 0.4
# Share in strange regions: .30 to .41 in Sponza, whose other side is an exact copy turned about and
# all that is found is at its place; .11 at most under true joins, in another light, too.
_LOOK_ALIKE_STRANGE = 0.2
NUM_SIGMAS_LIKELY = 1.64  # of 5 %


@dataclass(frozen=True, slots=True)
class Places:
    """Frames of one or of several parts of a map, and the points of their keypoints.

    Each part has a unit of its own, or all share that of one map.
    """

    world_T_rigs: np.ndarray  # (F, 4, 4) float64
    known: Sequence[np.ndarray]  # (F) of (K_f, 3): points of the keypoints of each frame, in its
    # rig frame, NaN where unknown

    def depths(self) -> np.ndarray:
        """Median distances (F,) of the points of each frame; NaN without points."""
        lengths = [np.linalg.norm(points, axis=1) for points in self.known]
        known = [length[np.isfinite(length)] for length in lengths]
        return np.array([np.median(some) if len(some) else np.nan for some in known])


@dataclass(frozen=True, slots=True)
class Predictions:
    """Points of one frame, predicted in another frame."""

    points_world: np.ndarray  # (V, 3) float64
    bins: np.ndarray  # (V,) int64, bin of the change of view
    off_rad: np.ndarray  # (V,) float64, angle from the prediction to the keypoint that matches
    # there; NaN = none does

    @classmethod
    def joined(cls, parts: Sequence["Predictions"]) -> "Predictions":
        """All of several."""
        nothing = cls(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0))
        every = (nothing, *parts)
        return cls(
            np.concatenate([part.points_world for part in every]),
            np.concatenate([part.bins for part in every]),
            np.concatenate([part.off_rad for part in every]),
        )

    @property
    def found(self) -> np.ndarray:
        """True (V,) where a keypoint near the prediction matches."""
        return np.isfinite(self.off_rad)

    @property
    def placed(self) -> np.ndarray:
        """Worth (V,) of what is found as evidence that it is at its place; 0 on average for
        matches by chance."""
        return np.where(self.found, np.where(self.off_rad < _PLACE_RAD, 1.0, _BESIDE), 0.0)


@dataclass(frozen=True, slots=True)
class FindingRates:
    """Rates at which predicted points are found."""

    within: np.ndarray  # (B,) float64, within parts, by change of view
    chance: float  # rate for predictions rotated away
    placed: np.ndarray  # (B,) float64, mean of `Predictions.placed` within parts


@dataclass(frozen=True, slots=True)
class JoinEvidence:
    """Evidence that the surroundings give for or against a join."""

    share: float  # found again, relative to a true join: 1 = as much as within parts, 0 = no more
    # than by chance
    sigma: float  # infinite: nothing can be predicted
    witnesses: int  # cells of space with predicted points
    placed: float = 0.0  # share found at its place
    placed_sigma: float = np.inf
    strange: float = 0.0  # of what is expected at its place: share in regions that show next to
    # nothing of it

    def __str__(self) -> str:
        if not self.witnesses:
            return "no frames of the two maps overlap at this place"
        return (
            f"{100 * self.share:.0f} % (sigma {100 * self.sigma:.0f} %) of the points "
            f"expected in both maps are found again, {100 * self.placed:.0f} % (sigma "
            f"{100 * self.placed_sigma:.0f} %) at their places, none in "
            f"{100 * self.strange:.0f} % of the regions; look-alikes: "
            f"{100 * _LOOK_ALIKE_SHARE:.0f} %, {100 * _LOOK_ALIKE_PLACED:.0f} % at their places, "
            f"none in {100 * _LOOK_ALIKE_STRANGE:.0f} % of the regions"
        )

    def margin(self, num_sigmas: float = SIGMAS_OF_1E_3) -> float:
        """Lower bounds of both shares, less what look-alikes have: the lesser of the two."""
        found = self.share - num_sigmas * self.sigma - _LOOK_ALIKE_SHARE
        return min(found, self.placed - num_sigmas * self.placed_sigma - _LOOK_ALIKE_PLACED)

    @property
    def confirmed(self) -> bool:
        """True if significantly more is found again, and at its place, than where two places look
        alike, and hardly a region is strange."""
        return self.margin() > 0 and not self.is_strange

    @property
    def likely(self) -> bool:
        """`confirmed` at a one-sided error rate of 5 % of each share."""
        return self.margin(NUM_SIGMAS_LIKELY) > 0 and not self.is_strange

    @property
    def is_strange(self) -> bool:
        """True if as large a share is strange as where two places look alike."""
        return self.strange >= _LOOK_ALIKE_STRANGE

    @property
    def doubted(self) -> bool:
        """True if it is refuted or strange."""
        return self.refuted or self.is_strange

    @property
    def refuted(self) -> bool:
        """True if significantly less is found again than under a true join."""
        return self.share + SIGMAS_OF_1E_3 * self.sigma < _LOOK_ALIKE_SHARE

    @property
    def absent(self) -> bool:
        """True if significantly less than a tenth is found again."""
        return self.share + SIGMAS_OF_1E_3 * self.sigma < 0.1

    def beats(self, other: "JoinEvidence") -> bool:
        """True if significantly more is at its place than under another join."""
        sigma = float(np.hypot(self.placed_sigma, other.placed_sigma))
        return self.placed - other.placed > SIGMAS_OF_1E_3 * sigma


def rates(
    context: MatchContext,
    places: Places,
    parts: np.ndarray,
    surfaces: bool = True,
    chosen: np.ndarray | None = None,
) -> FindingRates:
    """Rates at which points of a frame are found again in frames of its own part (F,), if both are
    `chosen` (F,) bool; for `surfaces` see `predict`."""
    compared = np.ones(len(parts), bool) if chosen is None else chosen
    rows = [np.flatnonzero(compared & (parts == p)) for p in np.unique(parts[compared])]
    pairs = np.concatenate([nearest_pairs(places, some, some) for some in rows])
    pairs = pairs[rows_across(len(pairs), _MAX_PAIRS)]
    seen = predict(context, places, pairs, surfaces)[0]
    poses, odd = places.world_T_rigs.copy(), np.arange(len(parts)) % 2 == 1
    poses[odd] = turned_away(poses[odd])
    turned = pairs[odd[pairs[:, 0]] != odd[pairs[:, 1]]]
    away = predict(context, replace(places, world_T_rigs=poses), turned, surfaces)[0]
    return rates_of(seen, away)


def turned_away(world_T_rigs: np.ndarray) -> np.ndarray:
    """Poses (..., 4, 4) turned about the rig's vertical, so that predictions are found by chance
    only."""
    cosine, sine = np.cos(_CHANCE_ROTATION_RAD), np.sin(_CHANCE_ROTATION_RAD)
    poses = world_T_rigs.copy()
    poses[..., :3, :3] = poses[..., :3, :3] @ [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    return poses


def rates_of(seen: Predictions, away: Predictions) -> FindingRates:
    """Rates of predictions at true poses, and of others at poses that are `turned_away`."""
    numbers = np.bincount(seen.bins, None, _NUM_BINS)

    def by_change_of_view(worth: np.ndarray) -> np.ndarray:
        hits = np.bincount(seen.bins, worth, _NUM_BINS)
        # .3 is assumed where no two frames of one part can be compared
        mean = (hits.sum() + _PRIOR_COUNT * 0.3) / (numbers.sum() + _PRIOR_COUNT)
        return (hits + _PRIOR_COUNT * mean) / (numbers + _PRIOR_COUNT)

    chance = float(away.found.mean()) if len(away.found) else 0.0
    return FindingRates(by_change_of_view(seen.found), chance, by_change_of_view(seen.placed))


def weigh(
    context: MatchContext,
    places: Places,
    groups: tuple[np.ndarray, np.ndarray],
    usual: FindingRates,
    depth: float,
    surfaces: bool = True,
) -> tuple[JoinEvidence, Matches]:
    """Weigh the evidence for and against a join of two groups (N,), (M,) of frames; with it the
    points found again, as matches of frames of both. `depth`: median distance of points, map
    units."""
    pairs = nearest_pairs(places, *groups)[:_MAX_PAIRS]
    seen, found = predict(context, places, pairs, surfaces)
    if not len(seen.bins):
        return JoinEvidence(0.0, np.inf, 0), found
    return evidence_of(seen, usual, depth), found


def evidence_of(seen: Predictions, usual: FindingRates, depth: float) -> JoinEvidence:
    """Evidence of predicted points: the weaker of two estimates, unless it is little anyway.

    By cells, a look-alike with many points is one witness. By points, so is a place of which only
    corners of walls and furniture are found again: flats of one plan share these, each in a cell
    of its own, but not what covers them.

    Args:
        depth: median distance of points, map units.
    """
    cells = np.floor(seen.points_world / (_CELL_DEPTHS * depth)).astype(np.int64)
    cells, cell_of = _distinct(cells)
    found = seen.found - usual.chance, usual.within[seen.bins] - usual.chance
    placed = seen.placed, usual.placed[seen.bins]
    regions = np.floor(cells * (_CELL_DEPTHS / _REGION_DEPTHS)).astype(np.int64)
    region_of = _distinct(regions)[1]

    def sums(
        counted: tuple[np.ndarray, np.ndarray], numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        worth, expected = (np.bincount(cell_of, some) / numbers for some in counted)
        return np.bincount(region_of, worth), np.bincount(region_of, expected)

    each, one = np.bincount(cell_of), np.ones(len(cells))
    regions_placed = sums(placed, one)
    at_place = *_share(*regions_placed), _strange(*regions_placed)
    by_cells, by_points = (
        JoinEvidence(*_share(*sums(found, numbers)), len(cells), *at_place)
        for numbers in (each, one)
    )
    if by_cells.likely:
        return min(by_cells, by_points, key=lambda one: one.share - SIGMAS_OF_1E_3 * one.sigma)
    return by_cells


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ascending distinct rows (D, 3), each row's number (N,); faster than `np.unique` by axis."""
    number_of = np.zeros(len(rows), np.int64)
    for column in rows.T:
        values, each = np.unique(column, return_inverse=True)
        firsts, number_of = np.unique(
            number_of * len(values) + each, return_index=True, return_inverse=True
        )[1:]
    return rows[firsts], number_of


def _share(excess: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Share found again and its standard deviation, from sums (R,) of regions."""
    unseen = float(expected.mean())  # a region with nothing found, and one with all, as a prior
    total = float(expected.sum()) + 2 * unseen
    share = (float(excess.sum()) + unseen) / total
    squares = float(np.sum((excess - share * expected) ** 2))
    squares += unseen**2 * (share**2 + (1 - share) ** 2)
    return share, float(np.sqrt(squares)) / total


def _strange(worth: np.ndarray, expected: np.ndarray) -> float:
    """Share of what is expected, in regions that show next to nothing of it, from sums (R,)."""
    judged = expected > 2.0
    total = float(expected[judged].sum())
    strange = judged & (worth < 0.15 * expected)  # less is next to nothing
    return float(expected[strange].sum()) / total if total else 0.0


def around(frames: np.ndarray, middle: int, reach: int = LOCAL) -> np.ndarray:
    """Frames (N,), ascending, at most `reach` before or after one of them: drift is small there."""
    place = int(np.searchsorted(frames, middle))
    return frames[max(place - reach, 0) : place + reach + 1]


def nearest_pairs(places: Places, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs (P, 2) int32 of nearby frames of two groups, the closest first, in both orders. Within
    one group, pairs whose matches make points are left out."""
    positions, depths = places.world_T_rigs[:, :3, 3], places.depths()
    found = set[tuple[int, int]]()
    for some, others in ((one, other), (other, one)):
        for f in some.tolist():
            apart = others[np.abs(others - f) > 2] if some is others else others
            distances = np.linalg.norm(positions[apart] - positions[f], axis=1)
            close = np.flatnonzero(distances < 2.0 * np.fmin(depths[apart], depths[f]))
            nearest = close[np.argsort(distances[close], kind="stable")][:_NUM_NEAREST]
            found |= {pair for g in apart[nearest].tolist() for pair in ((f, g), (g, f))}
    pairs = np.array(sorted(found), np.int32).reshape(-1, 2)
    lengths = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    return pairs[np.argsort(lengths, kind="stable")]


def predict(
    context: MatchContext, places: Places, pairs: np.ndarray, surfaces: bool
) -> tuple[Predictions, Matches]:
    """Predict points of the first frames of pairs (P, 2) in the second ones, and match them: with
    `surfaces` only points on surfaces that the second frame knows, else all, some of them
    occluded."""
    gates = [Gate.around_points(GATE_RAD)] * len(pairs)
    found = context.match(pairs, places.world_T_rigs, gates, places.known, guided_only=True)
    seen = context.keypoints.bearings_of
    parts = [
        predicted(places, f, g, found.of(p), seen(g), surfaces)
        for p, (f, g) in enumerate(pairs.tolist())
    ]
    return Predictions.joined(parts), found


def predicted(
    places: Places, f: int, g: int, matched: np.ndarray, bearings: np.ndarray, surfaces: bool
) -> Predictions:
    """Points of frame f, predicted in frame g, by keypoints (M, 2) of both that match near a
    prediction and by bearings (K, 3), unit, rig frame of g, of its keypoints."""
    rows = np.flatnonzero(np.isfinite(places.known[f]).all(axis=1))
    own, g_T_f = places.known[f][rows], inverse(places.world_T_rigs[g]) @ places.world_T_rigs[f]
    there = own @ g_T_f[:3, :3].T + g_T_f[:3, 3]
    distances = np.linalg.norm(there, axis=1)
    if surfaces:
        on = _on_surface(places.known[g], there / distances[:, None], distances)
        rows, own, there, distances = rows[on], own[on], there[on], distances[on]
    before = np.linalg.norm(own, axis=1)
    cosines = np.sum((own @ g_T_f[:3, :3].T) * there, axis=1) / (before * distances)
    angles = np.digitize(np.arccos(np.clip(cosines, -1, 1)), _ANGLE_EDGES_RAD)
    ratios = np.digitize(np.abs(np.log(before / distances)), _LOG_RATIO_EDGES)
    world_T_f = places.world_T_rigs[f]
    points = own @ world_T_f[:3, :3].T + world_T_f[:3, 3]
    seen = np.full((len(places.known[f]), 3), np.nan)
    seen[matched[:, 0]] = bearings[matched[:, 1]]
    off = angles_between(seen[rows], there)
    return Predictions(points, angles * (len(_LOG_RATIO_EDGES) + 1) + ratios, off)


def _on_surface(known: np.ndarray, directions: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """True (V,) for points, by direction and distance, on surfaces that points (K, 3) show."""
    points = known[np.isfinite(known).all(axis=1)]
    if not len(points):
        return np.zeros(len(distances), bool)
    lengths = np.linalg.norm(points, axis=1)
    tree = KDTree(points / lengths[:, None])
    # the three points of the frame that are nearest, within 6 degrees, represent the surface
    chords, nearest = tree.query(directions, 3, distance_upper_bound=2 * np.sin(np.deg2rad(3.0)))
    around = np.append(lengths, np.inf)[nearest].min(axis=1)
    known_there = np.isfinite(chords[:, 0])
    return known_there & (np.abs(np.log(around / distances)) < np.log(1.25))
