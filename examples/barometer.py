"""Barometer with an unknown bias: heights of frames in metres above an unknown level.

    gsba demo && python examples/barometer.py gsba-demo/walk level-run

The family's variables are the bias, and metres per map unit, as images do not determine the scale.
"""

import hashlib
import sys
from pathlib import Path

import gtsam
import numpy as np

from gsba import Family, MapSnapshot, RunResult, X, refine
from gsba.trajectory.files import read_trajectory

UP = np.array([0.0, -1.0, 0.0])  # the demo's first frame is level, and its y points down
B = gtsam.symbol("B", 0)  # [bias, metres per map unit]


class Barometer(Family):
    """Heights (F,) of frames in metres with a standard deviation and one common bias."""

    name = "barometer"

    def __init__(self, heights_m: np.ndarray, sigma_m: float) -> None:
        self.heights_m, self.sigma_m = heights_m, sigma_m
        self.digest = hashlib.sha256(heights_m.tobytes() + str(sigma_m).encode()).hexdigest()

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """Initial bias by the current poses, at one metre per unit."""
        values = gtsam.Values()
        bias = np.mean(self.heights_m - snapshot.world_T_rigs[:, :3, 3] @ UP)
        values.insert(B, np.array([bias, 1.0]))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """A factor for each frame, and a loose prior of one metre per unit."""
        graph, noise = (
            gtsam.NonlinearFactorGraph(),
            gtsam.noiseModel.Isotropic.Sigma(1, self.sigma_m),
        )
        for f, height_m in enumerate(self.heights_m.tolist()):
            graph.add(gtsam.CustomFactor(noise, [X(f), B], _error_of(height_m)))
        loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e3, 1.0]))
        graph.add(gtsam.PriorFactorVector(B, np.array([0.0, 1.0]), loose))
        return graph

    def report(self, snapshot: MapSnapshot) -> dict[str, float]:
        """Estimated bias and scale."""
        bias, metres = snapshot.variables.atVector(B)
        return {"bias_m": bias, "metres_per_unit": metres}


def _error_of(height_m: float):
    """Residual bias + metres * height in the map - height, and its Jacobians."""

    def error(factor, values, jacobians):
        pose, (bias, metres) = values.atPose3(factor.keys()[0]), values.atVector(B)
        height = UP @ pose.translation()
        if jacobians is not None:
            jacobians[0] = np.append(np.zeros(3), metres * UP @ pose.rotation().matrix())[None]
            jacobians[1] = np.array([[1.0, height]])
        return np.array([bias + metres * height - height_m])

    return error


def main(walk: Path, out: Path) -> RunResult:
    """Refine a walk of the demo with a simulated barometer that reads 100 m too much."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs
    truth = np.linalg.inv(truth[0]) @ truth  # the first frame becomes the world
    noise = np.random.default_rng(0).normal(0, 0.01, len(truth))
    barometer = Barometer(truth[:, :3, 3] @ UP + 100.0 + noise, 0.01)
    result = refine(walk / "images", walk / "slam.tum", out, families=[barometer])
    print(result.report["families"]["barometer"])
    return result


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
