"""Wheel odometry in metres, which sets the scale of the map.

gsba demo && python examples/wheel_odometry.py gsba-demo/walk metric-run
"""

import hashlib
import sys
from pathlib import Path

import gtsam
import numpy as np

from gsba import Family, MapSnapshot, RunResult, X, refine
from gsba.trajectory.files import read_trajectory


class WheelOdometry(Family):
    """Distances (F - 1,) from each frame to the next, metres, with a relative noise."""

    name = "wheels"
    fixes_gauge = True  # poses and points of the result are in metres
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(2.0)  # a slipping wheel is an outlier

    def __init__(self, metres: np.ndarray, relative_sigma: float) -> None:
        self.metres, self.relative_sigma = metres, relative_sigma
        self.digest = hashlib.sha256(metres.tobytes() + str(relative_sigma).encode()).hexdigest()

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """GTSAM's range factors under the robust loss."""
        graph = gtsam.NonlinearFactorGraph()
        typical = float(np.median(self.metres))
        for f, metres in enumerate(self.metres.tolist()):
            sigma = self.relative_sigma * max(metres, 0.1 * typical)
            noise = gtsam.noiseModel.Isotropic.Sigma(1, sigma)
            robust = gtsam.noiseModel.Robust.Create(self.loss, noise)
            graph.add(gtsam.RangeFactorPose3(X(f), X(f + 1), metres, robust))
        return graph

    def report(self, snapshot: MapSnapshot) -> dict[str, float]:
        """Median difference of wheels and images, and the length of the path, metres."""
        steps = np.linalg.norm(np.diff(snapshot.world_T_rigs[:, :3, 3], axis=0), axis=1)
        off = float(np.median(np.abs(steps - self.metres)))
        return {"median_difference_m": off, "path_m": float(steps.sum())}


def main(walk: Path, out: Path) -> RunResult:
    """Refine a walk of the demo with simulated wheels, by which a unit is 2.5 m."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs
    metres = 2.5 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    metres *= 1 + np.random.default_rng(0).normal(0, 0.01, len(metres))
    result = refine(walk / "images", walk / "slam.tum", out, families=[WheelOdometry(metres, 0.01)])
    print(result.report["families"]["wheels"])
    return result


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
