"""Two maps that meet: frames of both that know the same points, and the similarity between them."""

from dataclasses import dataclass

import numpy as np

from gsba.geometry import inverse, rotation_angle
from gsba.loop_closure.loops import AGREE, AGREE_DEG, MIN_GROUP, RIVAL
from gsba.similarity import Sim3, relative_similarity

_AGREE_LOG = 0.15  # of scales
_LOSS_DEG = 0.2  # scale of the robust loss: points of two maps err alike


@dataclass(frozen=True, slots=True)
class Meeting:
    """A frame outside a map and one inside that know the same points."""

    f: int  # outside
    g: int  # inside
    move: Sim3  # of the part of f into the map
    own: np.ndarray  # (m, 3) points in rig f, units of its part
    theirs: np.ndarray  # (m, 3) the same in rig g, units of the map


def measure(
    f: int, g: int, own: np.ndarray, theirs: np.ndarray, world_T_rigs: np.ndarray, seed: int
) -> Meeting | None:
    """The similarity that one pair of frames asks for; None if too few points agree.

    Args:
        f, g: frames outside and inside the map.
        own, theirs: (m, 3) points that both know, in rig f and in rig g, each in its own units.
        world_T_rigs: (F, 4, 4) each in its own map.
        seed: of the sampling.
    """
    found = relative_similarity(theirs, own, seed)
    if found is None:
        return None
    f_to_g, agree = found
    f_T_own = inverse(world_T_rigs[f])
    f_T_own[:3, 3] *= f_to_g.scale
    move = Sim3.of(f_to_g.scale, world_T_rigs[g] @ f_to_g.new_T_old @ f_T_own)
    return Meeting(f, g, move, own[agree], theirs[agree])


def agreeing(meetings: list[Meeting], poses: np.ndarray, depth: float) -> list[Meeting]:
    """The meetings that carry a part to one place, if they outweigh all that say another."""
    if not meetings:
        return []
    agree = np.array([[_alike(a, b, poses, depth) for b in meetings] for a in meetings])
    weights = np.array([len(meeting.own) for meeting in meetings])
    best = int(np.argmax(agree @ weights))
    group = [meetings[n] for n in np.flatnonzero(agree[best])]
    others = ~agree[best]
    contrary = (agree[others][:, others] @ weights[others]).max() if others.any() else 0
    distinct = min(len({m.f for m in group}), len({m.g for m in group}))
    enough = len(group) >= MIN_GROUP and distinct >= 2
    return group if enough and agree[best] @ weights >= RIVAL * contrary else []


def _alike(one: Meeting, other: Meeting, poses: np.ndarray, depth: float) -> bool:
    """Whether two meetings carry the frames of both to the same poses."""
    frames = poses[[one.f, other.f]]
    first, second = one.move.poses(frames), other.move.poses(frames)
    turned = rotation_angle(first[0, :3, :3].T @ second[0, :3, :3])
    off = np.linalg.norm(first[:, :3, 3] - second[:, :3, 3], axis=1).max()
    stretched = abs(np.log(one.move.scale / other.move.scale))
    near = off < AGREE * max(depth, 1e-12) and turned < np.deg2rad(AGREE_DEG)
    return bool(near and stretched < _AGREE_LOG)


def refined(group: list[Meeting], poses: np.ndarray) -> Sim3:
    """The similarity under which all meetings see their points best, from either side."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    start = max(group, key=lambda meeting: len(meeting.own)).move
    inside, outside = [], []  # positions in both worlds, and who sees them
    for m in group:
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
