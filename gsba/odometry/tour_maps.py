"""Maps of a tour: steps and the ratios of their lengths, confirmed by three frames at a time.

Two steps and a ratio give the pose of a third frame. Points that the first two frames triangulate
are searched there along whole epipolar lines: a place found where the point must appear is hardly
chance, and under another step or ratio next to none is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from factors.threads import map_in_threads
from gsba.camera.rig import cells_of
from gsba.geometry import angles_between, inverse, unit
from gsba.log import track
from gsba.odometry.tour_joins import Join, TourMap, scaled
from gsba.odometry.tour_merging import held
from gsba.odometry.tour_steps import (
    CELLS_PER_SIDE,
    MAX_ALIKE_LOG,
    MAX_OFF_RAD,
    MIN_PARALLAX_RAD,
    Step,
    TourFrame,
    agreed_logs,
    alike_poses,
    found_places,
    hypotheses,
)
from gsba.types import Counts, Matches, VerifiedPairs

STEPS_SEARCH = "searching along epipolar lines"  # work that progress is told of
_RATIO_WIDTH = 0.08  # of a ratio's logarithm, within which keypoints agree on it
_MAX_LOG_RATIO = np.log(4.0)  # of two steps' lengths
_NUM_RATIOS = 3  # that are tried for two hypotheses of steps
MIN_CELLS, MIN_LEAD = 7, 1.5  # cells that confirm three frames; times those of any rival
MIN_CELLS_OF_RATIO = 5  # where both steps are confirmed
MIN_END_RANK = 120.0  # of a step at an end, which one triple holds alone: in flats, three of five
# steps below it were off by 1 to 7 degrees
MAX_RIVAL_CELLS = 12  # of other steps or another ratio, from which the place repeats
MAX_RIVALLED_SHARE = 0.25  # of frames with such rivals, above which no place is believed
_LOG_SIGMA, _DIRECTION_SIGMA_RAD = 0.02, 0.01  # of confirmed ratios and steps


# Hypotheses of the step between two frames of these names: those of a search that was interrupted,
# or those that the function computes, kept.
KeptSteps = Callable[[tuple[str, str], Callable[[], list[Step]]], list[Step]]


@dataclass(frozen=True, slots=True)
class Triple:
    """Three frames in a row: two steps, and the ratio of their lengths."""

    log_ratio: float  # logarithm of the second step's length by the first one's
    cells: int  # of the sphere, in the first and the third frame, in which most places confirm it
    places2: np.ndarray  # (N,) + (3,) rays of the first frame's keys in the third; NaN = no fit
    places0: np.ndarray  # of the third frame's keys in the first


@dataclass(frozen=True, slots=True)
class TourMatches:
    """Confirmed steps of a tour, joined maps, and the places of keypoints that hold them."""

    starts: np.ndarray  # (F + 1,) int64, rays of each frame
    rays: np.ndarray  # (N, 3) of keypoints, and of places of those of other frames
    sigmas_rad: np.ndarray  # (N,) noise of the rays
    near: VerifiedPairs  # steps, pairs over two steps, and pairs over a join; matches number the
    # rays of a frame
    log_ratios: np.ndarray  # (F - 2,) logarithm of each step's length by that of the step before
    log_sigmas: np.ndarray  # (F - 2,) infinite = not known
    names: tuple[str, ...]  # (F,) of the frames, in the order of the way
    order_found: bool = False  # by likeness; False = that of the frames as they were given


def searched(
    frames: Sequence[TourFrame], names: Sequence[str], num_threads: int, kept: KeptSteps
) -> tuple[list[Step | None], list[Triple | None]]:
    """Steps (F - 1,) between frames (F,), of these names, None where descriptors propose none, and
    the triples (F - 2,) that confirm them, see `confirmed`."""
    num = len(frames)

    def step(f: int) -> list[Step]:
        return kept((names[f], names[f + 1]), lambda: hypotheses(frames[f], frames[f + 1]))

    found = map_in_threads(step, num - 1, num_threads)
    steps = list(track(found, STEPS_SEARCH, num - 1))

    def triples(f: int) -> dict[tuple[int, int], list[Triple]]:
        """Triples of each hypothesis of a step and each of the next, most cells first."""
        found = dict[tuple[int, int], list[Triple]]()
        for i, one in enumerate(steps[f]):
            for j, other in enumerate(steps[f + 1]):
                logs = ratios(one, other, frames[f + 1].keys)
                some = [triple(frames[f], frames[f + 2], one, other, log) for log in logs]
                found[i, j] = sorted(some, key=lambda each: -each.cells)
        return found

    chain, sure = confirmed(steps, list(map_in_threads(triples, num - 2, num_threads)))
    return [some[c] if some else None for some, c in zip(steps, chain, strict=True)], sure


def ratios(before: Step, after: Step, keys: np.ndarray) -> list[float]:
    """Logarithms of ratios of two steps' lengths that keypoints (N, 3) of the frame between them
    propose: those with most cells first, each without the keypoints of those before."""
    both = np.isfinite(before.depths1) & np.isfinite(after.depths0)
    logs = np.log(before.depths1[both] / after.depths0[both])
    found = agreed_logs(logs, cells_of(keys[both], CELLS_PER_SIDE), _RATIO_WIDTH, _NUM_RATIOS)
    return [log for log, _ in found if abs(log) < _MAX_LOG_RATIO]


def triple(
    first: TourFrame, third: TourFrame, before: Step, after: Step, log_ratio: float
) -> Triple:
    """Three frames, with the places in the first and the third that confirm two steps and a
    ratio."""
    length = np.exp(log_ratio)
    f2_T_f0 = scaled(after.f1_T_f0, length) @ before.f1_T_f0
    places2, cells2 = _confirming(first, third, before.depths0, f2_T_f0)
    places0, cells0 = _confirming(third, first, after.depths1 * length, inverse(f2_T_f0))
    return Triple(log_ratio, cells2 + cells0, places2, places0)


def _confirming(
    one: TourFrame, other: TourFrame, depths: np.ndarray, f1_T_f0: np.ndarray
) -> tuple[np.ndarray, int]:
    """Places (N, 3) in another frame of keys with depths (N,), where these predict them; NaN =
    elsewhere or not found; and cells in which most places found are predicted."""
    places = np.full((len(one.keys), 3), np.nan)
    rows = np.flatnonzero(np.isfinite(depths))
    length = np.linalg.norm(f1_T_f0[:3, 3])
    if not len(rows) or not length > 0:
        return places, 0
    along = f1_T_f0.copy()
    along[:3, 3] /= length
    rows, found = found_places(one, other, rows, along, 0.35)
    turned = one.keys[rows] @ f1_T_f0[:3, :3].T
    predicted = unit(turned * depths[rows, None] + f1_T_f0[:3, 3])
    good = angles_between(predicted, found) < MAX_OFF_RAD
    good &= angles_between(turned, found) > MIN_PARALLAX_RAD
    places[rows[good]] = found[good]
    balance = np.bincount(cells_of(one.keys[rows], CELLS_PER_SIDE), np.where(good, 1.0, -1.0))
    return places, int(np.count_nonzero(balance > 0))


def confirmed(
    steps: Sequence[Sequence[Step]], triples: Sequence[dict[tuple[int, int], list[Triple]]]
) -> tuple[list[int], list[Triple | None]]:
    """Hypothesis of each step (F - 1,), of the chain with most cells; and the triple (F - 2,) of
    each frame between two of these, None where it has few cells or another one rivals it. All are
    None where other ones have many cells at many frames: the place repeats, as a hall of bays
    does, and a shift by a bay is as consistent as the truth."""
    chain = _best_chain([max(len(some), 1) for some in steps], triples)
    pairs = list(pairwise(chain))
    first = [
        _best_and_rival(steps[f : f + 2], found, pair)
        for f, (found, pair) in enumerate(zip(triples, pairs, strict=True))
    ]
    if sum(rival >= MAX_RIVAL_CELLS for _, rival in first) > MAX_RIVALLED_SHARE * len(first):
        return chain, [None] * len(first)
    chosen = [best if _is_sure(best, rival) else None for best, rival in first]
    # Where frames beside confirm a step, rivals have it, too; of two such steps the ratio is open.
    known = [False, *(one is not None for one in chosen), False]
    for f, (found, pair) in enumerate(zip(triples, pairs, strict=True)):
        before, after = known[f], known[f + 2]
        if chosen[f] is None and (before or after):
            left = {
                at: some
                for at, some in found.items()
                if (at[0] == pair[0] or not before) and (at[1] == pair[1] or not after)
            }
            best, rival = _best_and_rival(steps[f : f + 2], left, pair)
            chosen[f] = best if _is_sure(best, rival, before and after) else None
    ranks = [some[c].rank if some else 0.0 for some, c in zip(steps, chain, strict=True)]
    while True:
        held = [some is not None for some in chosen]
        beside = zip([*held, False], [False, *held], ranks, strict=True)
        weak = [here != before and rank < MIN_END_RANK for here, before, rank in beside]
        if not any(weak):  # no triple holds a step of low rank alone
            return chain, chosen
        chosen = [None if weak[f] or weak[f + 1] else some for f, some in enumerate(chosen)]


def _is_sure(best: Triple | None, rival: int, steps_known: bool = False) -> bool:
    """True if a triple has enough cells, and enough more than its rivals."""
    if best is None or rival >= MAX_RIVAL_CELLS:
        return False
    least = MIN_CELLS_OF_RATIO if steps_known else MIN_CELLS
    return best.cells >= max(least, MIN_LEAD * rival)


def _best_and_rival(
    steps: Sequence[Sequence[Step]],
    found: dict[tuple[int, int], list[Triple]],
    pair: tuple[int, int],
) -> tuple[Triple | None, int]:
    """The triple of a pair of hypotheses with most cells, and the most cells of one that is not
    nearly the same."""
    best = next(iter(found.get(pair, ())), None)
    others = [(at, one) for at, some in found.items() for one in some if one is not best]
    if best is None:
        return None, max((one.cells for _, one in others), default=0)
    rivals = [0]
    for at, one in others:
        near = all(
            alike_poses(some[a].f1_T_f0, some[b].f1_T_f0)
            for some, a, b in zip(steps, pair, at, strict=True)
        )
        if not (near and abs(best.log_ratio - one.log_ratio) < MAX_ALIKE_LOG):
            rivals.append(one.cells)
    return best, max(rivals)


def _best_chain(
    sizes: Sequence[int], triples: Sequence[dict[tuple[int, int], list[Triple]]]
) -> list[int]:
    """Hypothesis of each step, of `sizes` hypotheses, whose triples have most cells."""
    total, back = np.zeros(sizes[0]), list[np.ndarray]()
    for found, size in zip(triples, sizes[1:], strict=True):
        gain = np.zeros((len(total), size))
        for (i, j), some in found.items():
            gain[i, j] = some[0].cells if some else 0
        total = total[:, None] + gain
        back.append(total.argmax(axis=0))
        total = total.max(axis=0)
    chain = [int(total.argmax())]
    for came_from in back[::-1]:
        chain.append(int(came_from[chain[-1]]))
    return chain[::-1]


def maps_of(
    frames: Sequence[TourFrame], steps: Sequence[Step | None], triples: Sequence[Triple | None]
) -> list[TourMap]:
    """Maps of the steps kept, and frames alone, in the order of the way."""
    kept, maps = _kept(steps, triples), list[TourMap]()
    for f, frame in enumerate(frames):
        step = kept[f - 1] if f else None
        if step is None:
            maps.append(TourMap(f, np.eye(4)[None], [np.full(len(frame.keys), np.nan)]))
            continue
        last = maps[-1]
        before, length = triples[f - 2] if f > 1 and not last.single else None, 1.0
        if before is not None:
            length = np.linalg.norm(last.between(f - 2, f - 1)[:3, 3]) * np.exp(before.log_ratio)
        moved = scaled(step.f1_T_f0, length) @ last.f_T_firsts[-1]
        poses = np.append(last.f_T_firsts, moved[None], axis=0)
        known = _agreeing(last.depths[-1], step.depths0 * length)
        maps[-1] = TourMap(last.first, poses, [*last.depths[:-1], known, step.depths1 * length])
    return maps


def _agreeing(depths: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Depths (N,) of two steps that agree, or of one where the other has none; NaN = none."""
    one, other = np.where(np.isfinite(depths), depths, others), others
    other = np.where(np.isfinite(other), other, one)
    agree = np.abs(np.log(one / other)) < 0.15  # of depths of a key by two steps, which agree
    return np.where(agree, (one + other) / 2, np.nan)


def _kept(steps: Sequence[Step | None], triples: Sequence[Triple | None]) -> list[Step | None]:
    """Steps (F - 1,) that a triple confirms, see `kept_steps`; None = left out."""
    sizes = [step.num if step else 0 for step in steps]
    kept = kept_steps([some is not None for some in triples], sizes)
    return [step if held else None for step, held in zip(steps, kept, strict=False)]


def matches_of(
    frames: Sequence[TourFrame],
    names: tuple[str, ...],
    steps: Sequence[Step | None],
    triples: Sequence[Triple | None],
    joined: Sequence[tuple[TourMap, TourMap, Join]],
) -> TourMatches:
    """Confirmed steps, triples and joins of maps, and the places that fit them."""
    kept = _kept(steps, triples)
    rays = [[frame.keys] for frame in frames]
    sigmas = [[frame.sigmas_rad] for frame in frames]
    pairs, rows, poses = list[tuple[int, int]](), list[np.ndarray](), list[np.ndarray]()

    def add(f0: int, f1: int, found1: np.ndarray, found0: np.ndarray) -> None:
        """Add matches of a pair: places (N, 3) of either frame's keys in the other one."""
        both = list[np.ndarray]()
        for f, g, found in ((f0, f1, found1), (f1, f0, found0)):
            seen = np.flatnonzero(np.isfinite(found[:, 0]))
            places = sum(map(len, rays[g])) + np.arange(len(seen))
            rays[g].append(found[seen])
            sigmas[g].append(np.full(len(seen), 1.5e-3))  # noise of a place that a search has found
            both.append(np.column_stack([seen, places] if f < g else [places, seen]))
        pairs.append((f0, f1))
        rows.append(np.concatenate(both).astype(np.int32))

    logs, log_sigmas = np.zeros(len(triples)), np.full(len(triples), np.inf)
    agreeing = [np.ones(len(frame.keys), bool) for frame in frames]
    threes = enumerate(zip(triples, kept[:-1], kept[1:], strict=True), start=1)
    tied = [(f, three, one, other) for f, (three, one, other) in threes if three and one and other]
    for f, found, before, after in tied:
        logs[f - 1], log_sigmas[f - 1] = found.log_ratio, _LOG_SIGMA
        off = np.abs(np.log(before.depths1 / after.depths0) - found.log_ratio)
        agreeing[f] = ~(off > _RATIO_WIDTH)  # true where a neighbour does not show the key
    for f, step in enumerate(kept):
        if step is None:
            continue
        found1 = np.where(agreeing[f][:, None], step.places1, np.nan)
        add(f, f + 1, found1, np.where(agreeing[f + 1][:, None], step.places0, np.nan))
        poses.append(inverse(step.f1_T_f0))
    for f, found, before, after in tied:
        add(f - 1, f + 1, found.places2, found.places0)
        second = scaled(inverse(after.f1_T_f0), np.exp(found.log_ratio))
        over = inverse(before.f1_T_f0) @ second
        over[:3, 3] = unit(over[:3, 3])
        poses.append(over)
    for one, other, at in joined:
        f, g = one.last, other.first
        length = np.log(np.linalg.norm(at.g_T_f[:3, 3]))
        if not one.single:
            before = np.linalg.norm(one.between(f - 1, f)[:3, 3])
            logs[f - 1], log_sigmas[f - 1] = length - np.log(before), _LOG_SIGMA
        if not other.single:
            after = np.linalg.norm(other.between(g, g + 1)[:3, 3])
            logs[g - 1], log_sigmas[g - 1] = at.log_scale + np.log(after) - length, _LOG_SIGMA
        for (f0, f1), f0_T_f1, found1, found0 in held(frames, one, other, at):
            add(f0, f1, found1, found0)
            poses.append(f0_T_f1)
    return TourMatches(
        np.cumsum([0, *(sum(map(len, some)) for some in rays)]),
        np.concatenate([one for some in rays for one in some]),
        np.concatenate([one for some in sigmas for one in some]),
        VerifiedPairs(
            Matches.of_rows(np.array(pairs, np.int32).reshape(-1, 2), rows),
            np.array(poses).reshape(-1, 4, 4),
            np.full(len(pairs), _DIRECTION_SIGMA_RAD),
            Counts(len(kept), sum(step is not None for step in kept), "pairs"),
        ),
        logs,
        log_sigmas,
        names,
    )


def kept_steps(tied: Sequence[bool], sizes: Sequence[int]) -> np.ndarray:
    """Steps (F - 1,) bool that a triple confirms, so that all neighbours among them have a known
    ratio of lengths: `tied` (F - 2,) says so of frames between two; of two steps without one, the
    one with the smaller size (F - 1,) is left out, and steps that have no neighbour then."""
    known = np.array(tied, bool)
    kept = np.append(known, False) | np.append(False, known)
    for f in np.flatnonzero(~known).tolist():
        if kept[f] and kept[f + 1]:
            kept[f if sizes[f] < sizes[f + 1] else f + 1] = False
    tied_steps = known & kept[:-1] & kept[1:]
    return np.append(tied_steps, False) | np.append(False, tied_steps)
