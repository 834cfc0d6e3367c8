"""Flat floor: the camera keeps its distance from an unknown plane.

    gsba demo && python examples/floor_plane.py gsba-demo/walk flat-run

The family's variables are the plane's normal (two degrees of freedom) and its distance from the
origin.
"""

import sys
from pathlib import Path

import gtsam
import numpy as np

from gsba import Family, MapSnapshot, RunResult, X, refine

N, D = gtsam.symbol("N", 0), gtsam.symbol("D", 0)


class FloorPlane(Family):
    """Distances of frames from a plane, with a standard deviation `sigma` in map units."""

    name = "floor"

    def __init__(self, sigma: float) -> None:
        self.sigma = sigma
        self.digest = str(sigma)

    def variables(self, snapshot: MapSnapshot) -> gtsam.Values:
        """Initial plane, fitted to the current positions."""
        positions = snapshot.world_T_rigs[:, :3, 3]
        middle = positions.mean(axis=0)
        normal = np.linalg.svd(positions - middle)[2][2]
        values = gtsam.Values()
        values.insert(N, gtsam.Unit3(normal))
        values.insert(D, float(normal @ middle))
        return values

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """A factor for each frame."""
        graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Isotropic.Sigma(1, self.sigma)
        for f in range(len(snapshot.world_T_rigs)):
            graph.add(gtsam.CustomFactor(noise, [X(f), N, D], _error))
        return graph

    def report(self, snapshot: MapSnapshot) -> dict[str, object]:
        """Estimated plane."""
        normal = snapshot.variables.atUnit3(N).point3()
        return {"normal": normal, "distance": snapshot.variables.atDouble(D)}


def _error(factor, values, jacobians):
    """Residual normal . position - distance, and its Jacobians."""
    pose, normal = values.atPose3(factor.keys()[0]), values.atUnit3(N)
    n, position = np.asarray(normal.point3()), pose.translation()
    if jacobians is not None:
        jacobians[0] = np.append(np.zeros(3), n @ pose.rotation().matrix())[None]
        jacobians[1] = (position @ normal.basis())[None]
        jacobians[2] = np.array([[-1.0]])
    return np.array([n @ position - values.atDouble(D)])


def main(walk: Path, out: Path) -> RunResult:
    """Refine a walk of the demo, whose camera moves up and down by some hundredths of a unit."""
    result = refine(walk / "images", walk / "slam.tum", out, families=[FloorPlane(0.03)])
    print(result.report["families"]["floor"])
    return result


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
