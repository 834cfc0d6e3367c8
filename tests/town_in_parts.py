"""A small town for tests of maps in parts: a walk around two squares that touch."""

from pathlib import Path

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X
from scipy.spatial.transform import Rotation

from factors import BearingTerm
from gsba.parts.folder import PartsWriter, values_at

NUM = 90
SIGMA = 5e-4


def town(seed: int = 0) -> tuple[np.ndarray, BearingTerm, np.ndarray, gtsam.NonlinearFactorGraph]:
    """Landmarks (J, 3), observations, pose rows (F, 12) to start from, and factors on poses."""
    rng = np.random.default_rng(seed)
    angle = 4 * np.pi * np.arange(NUM) / NUM
    second = np.arange(NUM) >= NUM // 2
    x = np.where(second, 16 - 8 * np.cos(angle), 8 * np.cos(angle))
    positions = np.column_stack([x, 0.1 * np.sin(3 * angle), 8 * np.sin(angle)])
    turns = Rotation.from_rotvec(np.column_stack([0 * angle, angle, 0 * angle]))
    hosts = np.repeat(np.arange(NUM), 12)
    points = positions[hosts] + rng.uniform(-3, 3, (len(hosts), 3))
    apart = np.linalg.norm(points[:, None] - positions, axis=2)
    owners, frames = np.nonzero((apart < 3.5) & (apart > 0.4))
    several = np.bincount(owners, minlength=len(points))[owners] > 1
    owners, frames = owners[several], frames[several]
    local = (
        Rotation.from_matrix(turns.as_matrix()[frames])
        .inv()
        .apply(points[owners] - positions[frames])
    )
    bearings = local / np.linalg.norm(local, axis=1, keepdims=True)
    bearings += SIGMA * rng.normal(size=bearings.shape)
    bearings[::40] += 0.05 * rng.normal(size=bearings[::40].shape)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    start = Rotation.from_rotvec(0.005 * rng.normal(size=(NUM, 3))) * turns
    moved = positions + 0.02 * rng.normal(size=(NUM, 3))
    rows = np.hstack([start.as_matrix().reshape(-1, 9), moved])
    points = points + 0.02 * rng.normal(size=points.shape)
    seen = frames.astype(np.int32), owners.astype(np.int32)
    term = BearingTerm(*seen, bearings, np.full(len(frames), SIGMA))
    return points, term, rows, _factors(positions, rng)


def _factors(positions: np.ndarray, rng: np.random.Generator) -> gtsam.NonlinearFactorGraph:
    """GPS fixes of all frames, and a few distances that are known."""
    graph = gtsam.NonlinearFactorGraph()
    for frame, position in enumerate(positions + 0.05 * rng.normal(size=(NUM, 3))):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.05)
        graph.add(gtsam.GPSFactor(X(frame), position, noise))
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Isotropic.Sigma(1, 0.01))
    for i, j in ((0, 5), (20, 60), (44, 46)):
        far = float(np.linalg.norm(positions[i] - positions[j]))
        graph.add(gtsam.RangeFactorPose3(X(i), X(j), far, noise))
    return graph


def write(folder: Path, most: int, num_chunks: int = 4) -> np.ndarray:
    """Write the town by parts, from a stream of a few chunks; returns where it starts."""
    points, term, rows, graph = town()
    writer = PartsWriter(folder)
    for chunk in np.array_split(np.arange(len(points)), num_chunks):
        chosen = np.isin(term.points, chunk)
        some = BearingTerm(
            term.frames[chosen],
            term.points[chosen] - chunk[0],
            term.bearings_rig[chosen],
            np.asarray(term.sigmas_rad)[chosen],
        )
        writer.add(points[chunk], [some], graph)
        graph = gtsam.NonlinearFactorGraph()
    values = values_at(range(NUM), rows)
    writer.finish(values, NUM, writer.cut(values, NUM, most))
    return rows
