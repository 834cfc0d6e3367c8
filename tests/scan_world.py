"""Rooms as a scan and as a run's cloud see them: points on rectangles, exact normals."""

import numpy as np
from scipy.spatial.transform import Rotation

from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3

Box = tuple[tuple[float, float, float], tuple[float, float, float]]  # low and high corner
HALL: tuple[Box, ...] = (  # two pieces of furniture, then what cannot be moved
    ((1.0, 0.4, 0.0), (1.9, 1.1, 0.8)),
    ((4.6, 0.9, 0.0), (5.4, 1.8, 1.4)),
    ((0.0, 2.5, 0.0), (2.3, 4.0, 2.6)),
    ((3.0, 0.0, 0.0), (3.2, 1.7, 2.6)),
    ((4.2, 2.7, 0.0), (6.0, 4.0, 0.9)),
    ((2.3, 3.3, 1.9), (6.0, 4.0, 2.6)),
)
SIZE = (6.0, 4.0, 2.6)
INTO_SCAN = Sim3(2.7, Rotation.from_rotvec([0.9, -0.4, 1.3]).as_matrix(), np.array([4.0, -7, 2]))


def rectangles(size: tuple[float, float, float], boxes: tuple[Box, ...]) -> np.ndarray:
    """Corner, both edges and the normal to the inside of the room, (R, 4, 3)."""
    found = []
    for n, (low, high) in enumerate([((0.0, 0.0, 0.0), size), *boxes]):
        low, edges = np.array(low), np.diag(np.array(high) - low)
        for axis in range(3):
            a, b = edges[(axis + 1) % 3], edges[(axis + 2) % 3]
            normal = np.eye(3)[axis] * (1 if n == 0 else -1)
            found.append([low, a, b, normal])
            found.append([low + edges[axis], a, b, -normal])
    return np.array(found)


def sampled(
    rng: np.random.Generator, rectangles: np.ndarray, num: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (num, 3), evenly over rectangles."""
    areas = np.linalg.norm(np.cross(rectangles[:, 1], rectangles[:, 2]), axis=1)
    rows = rng.choice(len(rectangles), num, p=areas / areas.sum())
    at = rng.uniform(size=(num, 2, 1))
    r = rectangles[rows]
    return r[:, 0] + at[:, 0] * r[:, 1] + at[:, 1] * r[:, 2], r[:, 3]


def visible(
    rng: np.random.Generator, size: tuple[float, float, float], boxes: tuple[Box, ...], num: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals on what of a room no box stands against."""
    points, normals = sampled(rng, rectangles(size, boxes), 2 * num)
    before = points + 1e-3 * normals
    seen = ((before > 0) & (before < size)).all(axis=1)
    for low, high in boxes:
        seen &= ~((before > low) & (before < high)).all(axis=1)
    return points[seen][:num], normals[seen][:num]


def cloud(
    size: tuple[float, float, float],
    boxes: tuple[Box, ...],
    seed: int,
    num: int = 1500,
    sigma: float = 0.002,
) -> Cloud:
    """A run's cloud in the room's own world, a tenth of it false."""
    rng = np.random.default_rng([seed, 0])
    points, normals = visible(rng, size, boxes, num)
    eyes = points + normals * rng.uniform(0.5, 1.5, (num, 1))
    eyes = np.clip(eyes, 0.05, np.array(size) - 0.05)
    points = points + sigma * rng.standard_normal((num, 3))
    false = rng.uniform(size=num) < 0.1
    points[false] += rng.normal(0, 0.4, (false.sum(), 3))
    covariances = np.tile(sigma**2 * np.eye(3), (num, 1, 1))
    return Cloud(points, covariances, eyes, np.arange(num), normals, np.zeros(num))


def scan(
    size: tuple[float, float, float],
    boxes: tuple[Box, ...],
    seed: int,
    into: Sim3 = INTO_SCAN,
    num: int = 20_000,
    noise: float = 0.005,
    missing: float = 0.33,
) -> Scan:
    """The room scanned, parts of it left out, in a world of its own."""
    rng = np.random.default_rng([seed, 1])
    points, normals = visible(rng, size, boxes, num)
    points = points + noise * rng.standard_normal((num, 1)) * normals
    left = np.ones(num, bool)
    while left.mean() > 1 - missing:
        hole = points[rng.choice(np.flatnonzero(left))]
        left &= np.linalg.norm(points - hole, axis=1) > rng.uniform(0.4, 0.9)
    return Scan(into.points(points[left]), normals[left] @ into.rotation.T)
