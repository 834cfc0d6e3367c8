"""Similarities of two maps, proposed by matched frames, and their refinement."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse, rotation_angle
from gsba.loop_closure.loops import AGREE, AGREE_DEG
from gsba.similarity import Sim3, agreeing_points, relative_similarity, similarity_along

_MAX_LOG_SCALE_DIFFERENCE = 0.15  # largest difference of logarithms of scales that agree
_LOSS_DEG = 0.2  # scale of the robust loss: points of two maps have correlated errors
_MIN_COMMON_POINTS = 6  # least common inliers of two frames that propose a similarity
_MAX_PROPOSALS = 6  # largest number of proposals that are tested


@dataclass(frozen=True, slots=True)
class Meeting:
    """A frame outside a map and one inside, and matched points that both have."""

    f: int  # outside
    g: int  # inside
    own: np.ndarray  # (m, 3) points in rig f, unit of its part
    theirs: np.ndarray  # (m, 3) the matched points in rig g, unit of the map
    g_T_f: np.ndarray | None = None  # (4, 4) relative pose by bearings, its translation of any
    # length; None = not known


@dataclass(frozen=True, slots=True)
class Proposal:
    """A similarity that moves a part into a map."""

    move: Sim3
    frames: tuple[int, int]  # outside and inside, whose points give the similarity
    support: int  # inliers among the points of all meetings


def propose(meetings: list[Meeting], poses: np.ndarray, depth: float, seed: int) -> list[Proposal]:
    """Similarities given by pairs of frames, those with the most inliers first.

    Args:
        meetings: meetings of frames outside and inside the map.
        poses: (F, 4, 4) each in its own map.
        depth: median distance of points, units of the map.
        seed: of the sampling.
    """
    found = []
    for m in meetings:
        similarity = _similarity_of_meeting(m, seed)
        if similarity is None:
            continue
        move = carrying(similarity, poses[m.f], poses[m.g])
        support = sum(len(each.own) for each in _inliers_of(meetings, move, poses))
        found.append(Proposal(move, (m.f, m.g), support))
    distinct: list[Proposal] = []
    for one in sorted(found, key=lambda proposal: -proposal.support):
        if not any(alike(one, other, poses, depth) for other in distinct):
            distinct.append(one)
    return distinct[:_MAX_PROPOSALS]


def carrying(g_T_f: Sim3, world_T_f: np.ndarray, world_T_g: np.ndarray) -> Sim3:
    """The similarity that moves the world of rig f into that of rig g.

    Args:
        g_T_f: rig f in rig g, with its unit.
        world_T_f, world_T_g: (4, 4) poses of both, each in the world of its map.
    """
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
    """True if two proposals move the frames of both to the same poses.

    Args:
        one, other: the proposals.
        poses: (F, 4, 4), each frame's in its own map.
        depth: median distance of points, map units.
        slack: tolerance, in typical differences of two estimates of one similarity.
    """
    frames = poses[[one.frames[0], other.frames[0]]]
    first, second = one.move.poses(frames), other.move.poses(frames)
    turned = rotation_angle(first[0, :3, :3].T @ second[0, :3, :3])
    off = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1).max()
    stretched = abs(np.log(one.move.scale / other.move.scale))
    near = off < slack * AGREE * max(depth, 1e-12)
    near &= turned < slack * np.deg2rad(AGREE_DEG)
    return bool(near and stretched < _MAX_LOG_SCALE_DIFFERENCE)


def refined(meetings: list[Meeting], start: Sim3, poses: np.ndarray) -> Sim3:
    """The similarity that minimises bearing residuals of all meetings, in both directions.

    Args:
        meetings: meetings whose points largely agree with `start`.
        start: similarity to start from; points that it does not map onto one another are left out.
        poses: (F, 4, 4) each in its own map.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    inside, outside = [], []  # positions in both worlds, and observing frames
    for m in _inliers_of(meetings, start, poses):
        for world, seer, seen in ((outside, m.f, m.own), (inside, m.g, m.theirs)):
            positions = seen @ poses[seer, :3, :3].T + poses[seer, :3, 3]
            world.append(np.hstack([positions, np.tile(poses[seer, :3, 3], (len(seen), 1))]))
    own, theirs = np.concatenate(outside), np.concatenate(inside)

    def directions(points: np.ndarray, seers: np.ndarray) -> np.ndarray:
        rays = points - seers
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def moved_by(x: np.ndarray) -> Sim3:
        rotation = Rotation.from_rotvec(x[:3]).as_matrix() @ start.rotation
        return Sim3(start.scale * float(np.exp(x[6])), rotation, start.translation + x[3:6])

    def residuals(x: np.ndarray) -> np.ndarray:
        move = moved_by(x)
        there, back = move.points(own[:, :3]), move.points_back(theirs[:, :3])
        seen = directions(there, theirs[:, 3:]) - directions(theirs[:, :3], theirs[:, 3:])
        sent = directions(back, own[:, 3:]) - directions(own[:, :3], own[:, 3:])
        return np.concatenate([seen.ravel(), sent.ravel()])

    x = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=np.deg2rad(_LOSS_DEG)).x
    return moved_by(x)
