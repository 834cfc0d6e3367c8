"""Similarities of two maps, proposed by matched frames, and their refinement."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse, rotation_angle, unit
from gsba.loop_closure.loops import AGREE, AGREE_DEG
from gsba.similarity import (
    Sim3,
    agreeing_points,
    are_aligned,
    relative_similarity,
    similarity_along,
)
from gsba.types import Matches

_LOSS_DEG = 0.2  # scale of the robust loss: points of two maps have correlated errors
_MIN_COMMON_POINTS = 6  # least common inliers of two frames that propose a similarity
_MIN_MEETINGS = 3  # least number of meetings by which a covariance is known
_BESIDE = 3  # frames to either side of a meeting whose points it may count
_MOST_POINTS = 20000  # of all meetings, by which similarities are compared


@dataclass(frozen=True, slots=True)
class Meeting:
    """A frame outside a map and one inside, and matched points that both have."""

    f: int  # outside
    g: int  # inside
    own: np.ndarray  # (m, 3) points in rig f, unit of its part
    theirs: np.ndarray  # (m, 3) the matched points in rig g, unit of the map
    g_T_f: np.ndarray | None = None  # (4, 4) relative pose by bearings, its translation of any
    # length; None = not known


def meetings_of(
    known: Sequence[np.ndarray],
    matches: Matches,
    outside: np.ndarray,
    f0_T_f1s: np.ndarray | None = None,
) -> list[Meeting]:
    """Matched points, as known (F) of (K_f, 3), rig frames, NaN = unknown, to both frames of pairs,
    one of them `outside` (N,); with relative poses (P, 4, 4) by bearings, of any length."""
    found = []
    for p, (f0, f1) in enumerate(matches.pairs.tolist()):
        matched = matches.of(p)
        (f, g), columns = ((f0, f1), (0, 1)) if f0 in outside else ((f1, f0), (1, 0))
        own = known[f][matched[:, columns[0]]]
        theirs = known[g][matched[:, columns[1]]]
        both = np.isfinite(own).all(axis=1) & np.isfinite(theirs).all(axis=1)
        if both.any():
            step = None if f0_T_f1s is None else f0_T_f1s[p]
            g_T_f = inverse(step) if step is not None and f == f0 else step
            found.append(Meeting(f, g, own[both], theirs[both], g_T_f))
    return found


@dataclass(frozen=True, slots=True)
class Proposal:
    """A similarity that moves a part into a map."""

    move: Sim3
    frames: tuple[int, int]  # outside and inside, whose points give the similarity
    support: int  # inliers among the points of all meetings, or among some of very many


def propose(meetings: list[Meeting], poses: np.ndarray, depth: float, seed: int) -> list[Proposal]:
    """Similarities given by pairs of frames, the most inliers first; where no pair shares enough
    points, each counts those of the pairs beside it, too. Poses (F, 4, 4) are each in its own
    map."""
    found = _proposed(meetings, meetings, poses, seed)
    if not found:
        found = _proposed([_pooled(m, meetings, poses) for m in meetings], meetings, poses, seed)
    distinct: list[Proposal] = []
    for one in sorted(found, key=lambda proposal: -proposal.support):
        if not any(alike(one, other, poses, depth) for other in distinct):
            distinct.append(one)
    return distinct[:6]


def _proposed(
    given: list[Meeting], meetings: list[Meeting], poses: np.ndarray, seed: int
) -> list[Proposal]:
    """A proposal of each meeting given that has one, supported by all meetings."""
    if not meetings:
        return []
    found = []
    at_f, own = _in_world(poses, [(m.f, m.own) for m in meetings])
    at_g, theirs = _in_world(poses, [(m.g, m.theirs) for m in meetings])
    some = slice(None, None, len(own) // _MOST_POINTS + 1)
    at_f, own, at_g, theirs = at_f[some], own[some], at_g[some], theirs[some]
    for m in given:
        similarity = _similarity_of_meeting(m, seed)
        if similarity is None:
            continue
        move = carrying(similarity, poses[m.f], poses[m.g])
        agree = are_aligned(move.points(own) - at_g, theirs - at_g)
        agree &= are_aligned(move.points_back(theirs) - at_f, own - at_f)
        found.append(Proposal(move, (m.f, m.g), int(agree.sum())))
    return found


def _in_world(
    poses: np.ndarray, seen: list[tuple[int, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) of rigs, and the points (N, 3) that they see, each in its map's world."""
    at = [np.broadcast_to(poses[rig, :3, 3], points.shape) for rig, points in seen]
    world = [Sim3.of(1.0, poses[rig]).points(points) for rig, points in seen]
    return np.concatenate(at), np.concatenate(world)


def _pooled(meeting: Meeting, meetings: list[Meeting], poses: np.ndarray) -> Meeting:
    """A meeting with the points of those at most `_BESIDE` frames away, each point once."""
    near = [m for m in meetings if max(abs(m.f - meeting.f), abs(m.g - meeting.g)) <= _BESIDE]

    def seen_from(rig: int, seer: int, points: np.ndarray) -> np.ndarray:
        return Sim3.of(1.0, inverse(poses[rig]) @ poses[seer]).points(points)

    own = np.concatenate([seen_from(meeting.f, m.f, m.own) for m in near])
    theirs = np.concatenate([seen_from(meeting.g, m.g, m.theirs) for m in near])
    smallest = 1e-6 * np.median(np.linalg.norm(own, axis=1))
    _, once = np.unique(np.round(own / smallest), axis=0, return_index=True)
    return replace(meeting, own=own[once], theirs=theirs[once])


def carrying(g_T_f: Sim3, world_T_f: np.ndarray, world_T_g: np.ndarray) -> Sim3:
    """The similarity that moves the world of rig f into that of rig g, by poses (4, 4) in these."""
    f_T_own = inverse(world_T_f)
    f_T_own[:3, 3] *= g_T_f.scale
    return Sim3.of(g_T_f.scale, world_T_g @ g_T_f.new_T_old @ f_T_own)


def _similarity_of_meeting(meeting: Meeting, seed: int) -> Sim3 | None:
    """The similarity of rig f in rig g with the most inliers of a meeting."""
    given = meeting.theirs, meeting.own
    found = [relative_similarity(*given, seed, _MIN_COMMON_POINTS)]
    if meeting.g_T_f is not None:
        found.append(similarity_along(*given, meeting.g_T_f, _MIN_COMMON_POINTS))
    some = [one for one in found if one is not None]
    return max(some, key=lambda one: int(one[1].sum()))[0] if some else None


def _inliers_of(meetings: list[Meeting], move: Sim3, poses: np.ndarray) -> list[Meeting]:
    """The inliers of meetings under a similarity."""
    found = []
    for m in meetings:
        world_T_f = move.poses(poses[m.f])
        g_T_f = Sim3.of(move.scale, inverse(poses[m.g]) @ world_T_f)
        rows = agreeing_points(m.theirs, m.own, g_T_f)
        found.append(replace(m, own=m.own[rows], theirs=m.theirs[rows]))
    return found


def alike(
    one: Proposal, other: Proposal, poses: np.ndarray, depth: float, slack: float = 1.0
) -> bool:
    """True if two proposals move the frames of both, poses (F, 4, 4) each in its own map, to the
    same poses; `depth` in map units, `slack` in typical differences of two estimates."""
    frames = poses[[one.frames[0], other.frames[0]]]
    off, turned, stretched = difference(one.move, other.move, frames)
    near = off < slack * AGREE * max(depth, 1e-12)
    near &= turned < slack * np.deg2rad(AGREE_DEG)
    return bool(near and stretched < 0.15)


def difference(one: Sim3, other: Sim3, poses: np.ndarray) -> tuple[float, float, float]:
    """Largest distance, angle in radians and logarithm of the ratio of scales between poses
    (F, 4, 4) moved by two similarities."""
    first, second = one.poses(poses), other.poses(poses)
    off = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1).max()
    turned = rotation_angle(first[0, :3, :3].T @ second[0, :3, :3])  # of all poses alike
    return float(off), float(turned), float(abs(np.log(one.scale / other.scale)))


def refined(meetings: list[Meeting], start: Sim3, poses: np.ndarray) -> Sim3:
    """The similarity that minimises bearing residuals of meetings in both directions, from `start`
    on; points that it does not map onto one another are left out."""
    from scipy.optimize import least_squares

    residuals = _residuals_of(_inliers_of(meetings, start, poses), poses)
    given = {"loss": "soft_l1", "f_scale": np.deg2rad(_LOSS_DEG)}
    about = start.translation
    x = least_squares(lambda x: residuals(start.moved(x, about)).ravel(), np.zeros(7), **given).x
    return start.moved(x, about)


def similarity_covariance(meetings: list[Meeting], move: Sim3, poses: np.ndarray) -> np.ndarray:
    """Covariance (7, 7) of a similarity that `refined` has found, of a step of `Sim3.moved`
    about its translation.

    Points of one meeting have common errors: residuals count as correlated within a meeting, and
    as independent between meetings (Liang and Zeger, Biometrika 73(1), 1986). NaN where fewer than
    three have inliers: the similarity fits the common errors of so few.
    """
    step, about = 1e-6, move.translation
    every = [one for one in _inliers_of(meetings, move, poses) if len(one.own)]
    if len(every) < _MIN_MEETINGS:
        return np.full((7, 7), np.nan)
    normal, scores = np.zeros((7, 7)), np.zeros((7, 7))
    for meeting in every:
        residuals = _residuals_of([meeting], poses)
        found = residuals(move)
        columns = [
            (residuals(move.moved(x, about)) - residuals(move.moved(-x, about))) / (2 * step)
            for x in step * np.eye(7)
        ]
        jacobian = np.stack([column.ravel() for column in columns], axis=1)
        flat = found.ravel()
        weights = 1 / np.sqrt(1 + (flat / np.deg2rad(_LOSS_DEG)) ** 2)
        normal += (jacobian * weights[:, None]).T @ jacobian
        score = (jacobian * weights[:, None]).T @ flat
        scores += np.outer(score, score)
    few = len(every) / max(len(every) - 7, 1)  # residuals of few meetings are fitted away
    inverse_ = np.linalg.pinv(normal)
    return few * inverse_ @ scores @ inverse_


def _residuals_of(meetings: list[Meeting], poses: np.ndarray) -> Callable[[Sim3], np.ndarray]:
    """Differences (2 N, 3) of bearings of meetings' points in both directions, by similarity."""
    own_seers, own = _in_world(poses, [(m.f, m.own) for m in meetings])
    their_seers, theirs = _in_world(poses, [(m.g, m.theirs) for m in meetings])

    def residuals(move: Sim3) -> np.ndarray:
        there, back = move.points(own), move.points_back(theirs)
        seen = unit(there - their_seers) - unit(theirs - their_seers)
        sent = unit(back - own_seers) - unit(own - own_seers)
        return np.concatenate([seen, sent])

    return residuals
