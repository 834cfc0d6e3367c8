"""A robust loss of your own: Barron's general loss, on wheels a third of whose steps slipped.

    gsba demo && python examples/robust_loss.py gsba-demo/walk slipped-run

GTSAM takes the weight and the loss of a whitened residual as two functions of one number.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from wheel_odometry import WheelOdometry

from gsba import RunResult, refine
from gsba.trajectory.files import read_trajectory


@dataclass(frozen=True)
class GeneralLoss:
    """Loss of "A general and adaptive robust loss function" (Barron, CVPR 2019).

    In GTSAM's scaling, r^2 / 2 near zero. Shape 1 is the smoothed L1, -2 is Geman-McClure; the
    smaller the shape, the less outliers count. Shapes 0 and 2 are limits, left out here.
    """

    shape: float
    scale: float  # standard deviations from which on residuals count less

    def _base(self, residual: float) -> float:
        return (residual / self.scale) ** 2 / abs(self.shape - 2) + 1

    def weight(self, residual: float) -> float:
        """Derivative of the loss over the residual."""
        return self._base(residual) ** (self.shape / 2 - 1)

    def loss(self, residual: float) -> float:
        """Loss of a whitened residual."""
        factor = self.scale**2 * abs(self.shape - 2) / self.shape
        return factor * (self._base(residual) ** (self.shape / 2) - 1)


class SlippingWheels(WheelOdometry):
    """Wheels of which many steps are too long."""

    name = "slipping_wheels"

    def __init__(self, metres: np.ndarray, relative_sigma: float, loss: GeneralLoss) -> None:
        super().__init__(metres, relative_sigma)
        self.loss = gtsam.noiseModel.mEstimator.Custom(loss.weight, loss.loss)
        self.digest += str(loss)


def main(walk: Path, out: Path) -> RunResult:
    """Refine a walk of the demo with simulated wheels, by which a unit is 2.5 m."""
    truth = read_trajectory(walk / "groundtruth.tum").world_T_rigs
    metres = 2.5 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    rng = np.random.default_rng(0)
    metres *= 1 + rng.normal(0, 0.01, len(metres))
    metres[rng.permutation(len(metres))[: len(metres) // 3]] *= 1.3
    wheels = SlippingWheels(metres, 0.01, GeneralLoss(-4.0, 2.0))
    result = refine(walk / "images", walk / "slam.tum", out, families=[wheels])
    print(result.report["families"]["slipping_wheels"])
    return result


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
