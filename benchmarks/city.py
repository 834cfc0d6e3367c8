"""A synthetic city, streamed: what a camera sees that drives all streets of a grid.

Streets are straight, 100 m from crossing to crossing; some are driven twice, a little to the side.
Points lie on facades and are seen from all frames near them, so that streets meet at crossings, and
drives of the same street in all of it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from factors import BearingTerm

BLOCK_M = 100.0  # from crossing to crossing
SIGMA_RAD = np.radians(0.05)  # of bearings, per axis
GPS_SIGMA_M = 0.5
_POINTS_A_FRAME = 100
_MOST = 12  # observations of a point
_TWICE = 0.1  # share of streets that are driven a second time
_OUTLIERS = 0.02
_DRIFT_M, _DRIFT_RAD = 0.3, np.radians(0.3)  # of the start, standard deviations
_DRIFT_FRAMES = 200.0  # length over which it changes
_HOSTS = 1000  # frames whose points are generated at a time


@dataclass(frozen=True)
class City:
    """Frames of a city, true and as they start; their points are generated as they are asked for.

    Args:
        truth: (F, 12) pose rows.
        start: (F, 12) pose rows.
        seed: of all that is random.
    """

    truth: np.ndarray
    start: np.ndarray
    seed: int

    def chunks(self) -> Iterator[tuple[np.ndarray, BearingTerm, gtsam.NonlinearFactorGraph]]:
        """Landmarks (J, 3), their observations and GPS fixes, those of some frames at a time."""
        tree = KDTree(self.truth[:, [9, 11]])
        for first in range(0, len(self.truth), _HOSTS):
            hosts = np.arange(first, min(first + _HOSTS, len(self.truth)))
            rng = np.random.default_rng([self.seed, first])
            yield *self._seen(hosts, tree, rng), self._fixes(hosts, rng)

    def _seen(
        self, hosts: np.ndarray, tree: KDTree, rng: np.random.Generator
    ) -> tuple[np.ndarray, BearingTerm]:
        """Points on facades beside frames, and all frames that see them."""
        hosts = np.repeat(hosts, _POINTS_A_FRAME)
        num = len(hosts)
        aside = rng.uniform(5, 10, num) * rng.choice([-1.0, 1.0], num)
        offsets = np.column_stack([aside, rng.uniform(-8, 2, num), rng.uniform(-0.5, 0.5, num)])
        points = _placed(self.truth[hosts], offsets)
        reach = np.abs(aside) + rng.uniform(0.3, 1.5, num)
        found: tuple[Any, Any] = tree.query(points[:, [0, 2]], k=_MOST)
        far, near = found
        seen = far < reach[:, None]
        seen &= np.count_nonzero(seen, axis=1)[:, None] > 1
        owners, which = np.nonzero(seen)
        frames = near[owners, which].astype(np.int32)
        kept = seen.any(axis=1)
        local = np.cumsum(kept) - 1
        bearings = _noisy(_local(self.truth[frames], points[owners]), SIGMA_RAD, rng)
        wild = rng.random(len(bearings)) < _OUTLIERS
        bearings[wild] = _noisy(bearings[wild], np.radians(3.0), rng)
        guess = offsets * (1 + 0.02 * rng.normal(size=(num, 1)))
        seen_by = frames, local[owners].astype(np.int32)
        term = BearingTerm(*seen_by, bearings, np.full(len(bearings), SIGMA_RAD))
        return _placed(self.start[hosts], guess)[kept], term

    def _fixes(self, frames: np.ndarray, rng: np.random.Generator) -> gtsam.NonlinearFactorGraph:
        """A GPS fix of each frame."""
        graph = gtsam.NonlinearFactorGraph()
        noise = gtsam.noiseModel.Isotropic.Sigma(3, GPS_SIGMA_M)
        fixes = self.truth[frames, 9:] + GPS_SIGMA_M * rng.normal(size=(len(frames), 3))
        for frame, fix in zip(frames.tolist(), fixes, strict=True):
            graph.add(gtsam.GPSFactor(X(frame), fix, noise))
        return graph


def make_city(num_frames: int, seed: int = 0) -> City:
    """A city of as many blocks as a camera drives along in `num_frames` frames, 1 m apart."""
    rng = np.random.default_rng(seed)
    blocks = 1
    while _length(blocks + 1) <= num_frames:
        blocks += 1
    streets: list[np.ndarray] = []
    along = np.arange(0, blocks * BLOCK_M)
    for way in (0, 1):
        for line in range(blocks + 1):
            streets.append(_street(way, line * BLOCK_M, along, back=bool(line % 2)))
    drives = [*streets]
    while sum(map(len, drives)) < num_frames:
        again = streets[int(rng.integers(len(streets)))].copy()
        again[:, :2] += 1.5 * np.column_stack([np.cos(again[:, 2]), -np.sin(again[:, 2])])
        drives.append(again)
    path = np.concatenate(drives)[:num_frames]
    turns = Rotation.from_rotvec(np.column_stack([0 * path[:, 2], path[:, 2], 0 * path[:, 2]]))
    height = 1.7 + 0.02 * rng.normal(size=num_frames)
    truth = _rows(turns, np.column_stack([path[:, 0], -height, path[:, 1]]))
    drift = _wandering(num_frames, rng)
    moved = Rotation.from_rotvec(_DRIFT_RAD * drift[:, :3])
    start = _rows(moved * turns, truth[:, 9:] + _DRIFT_M * drift[:, 3:])
    return City(truth, start, seed)


def _length(blocks: int) -> float:
    """Frames of a city of so many blocks a side."""
    return 2 * (blocks + 1) * blocks * BLOCK_M * (1 + _TWICE)


def _street(way: int, at: float, along: np.ndarray, back: bool) -> np.ndarray:
    """(N, 3) places x, z and headings of a drive along a street of a grid."""
    heading = (np.pi / 2 if way == 0 else 0.0) + (np.pi if back else 0.0)
    along = along[::-1] if back else along
    constant = np.full(len(along), at)
    places = (along, constant) if way == 0 else (constant, along)
    return np.column_stack([*places, np.full(len(along), heading)])


def _wandering(num: int, rng: np.random.Generator) -> np.ndarray:
    """(N, 6) of unit variance, each coordinate wandering slowly."""
    from scipy.signal import lfilter

    keep = np.exp(-1 / _DRIFT_FRAMES)
    steps = np.sqrt(1 - keep**2) * rng.normal(size=(num, 6))
    return np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0))


def _rows(turns: Rotation, positions: np.ndarray) -> np.ndarray:
    return np.hstack([turns.as_matrix().reshape(-1, 9), positions])


def _placed(rows: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """World points (N, 3) at offsets (N, 3) in the frames of pose rows (N, 12)."""
    return np.einsum("nij,nj->ni", rows[:, :9].reshape(-1, 3, 3), offsets) + rows[:, 9:]


def _local(rows: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) in the frames of pose rows (N, 12)."""
    return np.einsum("nji,nj->ni", rows[:, :9].reshape(-1, 3, 3), points - rows[:, 9:])


def _noisy(vectors: np.ndarray, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Unit vectors along (N, 3), turned by noise of a standard deviation per axis."""
    units = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    moved = units + sigma * rng.normal(size=units.shape)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)
