"""Maps on either side of a short break of a recording, across which the camera moved on: pairs of
frames give the step across in either map's unit, and so the ratio of the units."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import inverse, rotation_angle
from gsba.loop_closure.map_similarity import Proposal, alike, carrying
from gsba.similarity import Sim3
from gsba.trajectory.steps import ray_depths
from gsba.types import Keypoints, VerifiedPairs

MIN_AGREEING = 3  # least number of pairs
_REACH = 4  # steps of the map before or after a break that tell how fast the camera moves
# Slowest and fastest motion over a break, in the median of these steps: other bays are elsewhere.
_MIN_PACES, _MAX_PACES = 0.5, 1.5


def crossing(
    pairs: VerifiedPairs,
    keypoints: Keypoints,
    poses: np.ndarray,
    known: list[np.ndarray],
    outside: np.ndarray,
) -> list[Proposal]:
    """Similarities of a part and the map, one from each pair of frames over a break; `known` (F) of
    (K_f, 3) are points of keypoints, rig frames, NaN = unknown."""
    found = []
    for p, (f0, f1) in enumerate(pairs.matches.pairs.tolist()):
        if not np.isfinite(pairs.direction_sigmas[p]):
            continue
        f, g = (f0, f1) if f0 in outside else (f1, f0)
        rows, f0_T_f1 = pairs.matches.of(p), pairs.f0_T_f1s[p]
        rays0, rays1 = keypoints.matched(pairs.matches.pairs[p], rows)
        lengths = {
            f0: _step_length(known[f0][rows[:, 0]], ray_depths(rays0, rays1, f0_T_f1)),
            f1: _step_length(known[f1][rows[:, 1]], ray_depths(rays1, rays0, inverse(f0_T_f1))),
        }
        in_own, in_map = lengths[f], lengths[g]
        if in_own is None or in_map is None:
            continue
        g_T_f = inverse(f0_T_f1) if f0 == f else f0_T_f1.copy()
        g_T_f[:3, 3] *= in_map
        move = carrying(Sim3.of(in_map / in_own, g_T_f), poses[f], poses[g])
        found.append(Proposal(move, (f, g), len(rows)))
    return found


def agreed(
    proposals: list[Proposal],
    poses: np.ndarray,
    depth: float,
    nearest: tuple[int, int] | None = None,
) -> Proposal | None:
    """The proposal that most others agree with, of several the one with most matches; None without
    a majority.

    Args:
        proposals: one of each pair of frames.
        poses: (F, 4, 4), each frame's in its own map.
        depth: its median, map units.
        nearest: frames next to one another, which share most: one more pair that agrees with them
            suffices. Frames further apart may show other bays of a hall.
    """
    counts = [sum(alike(one, other, poses, depth) for other in proposals) for one in proposals]
    enough = [
        count > len(proposals) // 2 and count >= MIN_AGREEING - (one.frames == nearest)
        for one, count in zip(proposals, counts, strict=True)
    ]
    chosen = np.flatnonzero(enough).tolist()
    best = max(chosen, key=lambda n: (counts[n], proposals[n].support), default=None)
    return None if best is None else proposals[best]


@dataclass(frozen=True, slots=True)
class Breaks:
    """Breaks between a part and the map: where a camera that walks on can be behind them."""

    steps: list[tuple[int, int]]  # a frame of the part and one of the map, next to one another in
    # time
    part: np.ndarray  # (N,) frames of the part, ascending
    inside: np.ndarray  # (M,) frames of the map, ascending
    poses: np.ndarray  # (F, 4, 4), each frame's in its own map
    timestamps: np.ndarray  # (F,) seconds

    def continued_by(self, move: Sim3) -> bool:
        """True if a similarity lets the part follow the map as a camera that walks on: at each
        break about as far away as it goes in that time, not back, and not turned about."""
        for f, g in self.steps:
            usual = self._velocities(move, f, g)
            if not usual:
                return False
            moved, last = move.poses(self.poses[[f]])[0], self.poses[g]
            velocity = (moved[:3, 3] - last[:3, 3]) / (self.timestamps[f] - self.timestamps[g])
            paces = np.linalg.norm(velocity) / np.linalg.norm(usual[0])
            if velocity @ usual[0] < 0 or not _MIN_PACES < paces < _MAX_PACES:
                return False
            # largest turn over a break
            if rotation_angle(last[:3, :3].T @ moved[:3, :3]) > np.deg2rad(60.0):
                return False
        return bool(self.steps)

    def at_usual_pace(self, move: Sim3) -> list[Sim3]:
        """Similarities that move the part as one does, and then along the camera's way until it
        walks on at about the usual pace: in a hall of bays, matches agree on steps that are a bay
        too short."""
        found = list[Sim3]()
        for f, g in self.steps:
            step = move.poses(self.poses[[f]])[0, :3, 3] - self.poses[g, :3, 3]
            for velocity in self._velocities(move, f, g):
                expected = velocity * (self.timestamps[f] - self.timestamps[g])
                along = expected / np.linalg.norm(expected)
                across = step - (step @ along) * along
                found += [
                    replace(move, translation=move.translation + across + paces * expected - step)
                    for paces in (0.8, 0.9, 1.0, 1.1, 1.25)
                ]
        return found

    def _velocities(self, move: Sim3, f: int, g: int) -> list[np.ndarray]:
        """Velocities (3,) that the camera may have between g of the map and f of the moved part."""
        theirs = self._beside(g, f, self.inside)
        ours = move.scale * self._beside(f, g, self.part) @ move.rotation.T
        speed = float(np.median(np.linalg.norm(theirs, axis=1))) if len(theirs) else 0.0
        nearest = [some[0] for some in (theirs, ours) if len(some) and some[0].any()]
        ways = [first / np.linalg.norm(first) for first in nearest]
        if not speed or not ways:
            return []
        ways = [np.mean(ways, axis=0), *ways] if len(ways) > 1 else ways
        return [speed * way / np.linalg.norm(way) for way in ways if way.any()]

    def _beside(self, g: int, f: int, rows: np.ndarray) -> np.ndarray:
        """Velocities (n, 3) of up to `_REACH` steps of `rows` beside g, away from f"""
        ends = g + np.sign(g - f) * np.arange(_REACH + 1)
        ends = ends[: int(np.argmin(np.append(np.isin(ends, rows), False)))]
        steps = np.diff(self.poses[ends, :3, 3], axis=0)
        return steps / np.diff(self.timestamps[ends])[:, None]


def _step_length(known: np.ndarray, depths: np.ndarray) -> float | None:
    """Length of a step in a map's unit, by points (m, 3) and depths (m,); None = uncertain."""
    logs = np.log(np.linalg.norm(known, axis=1) / depths)
    logs = logs[np.isfinite(logs)]
    if len(logs) < 8:  # points of a pair that either map must hold
        return None
    middle = float(np.median(logs))
    sigma = 1.25 * 1.4826 * float(np.median(np.abs(logs - middle))) / np.sqrt(len(logs))
    return float(np.exp(middle)) if sigma < 0.1 else None  # far points determine no scale
