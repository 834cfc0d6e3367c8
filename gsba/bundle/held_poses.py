"""A family that holds poses where they are, for maps that grow while a part of them stays."""

from dataclasses import dataclass

import gtsam
import numpy as np

from gsba.bundle.families import Family, MapSnapshot, digest_of
from gsba.bundle.pose_variables import X

_SIGMA = 1e-7  # of a held pose: radians, and part of the extent of all held poses


@dataclass(frozen=True, slots=True)
class HeldPoses(Family):
    """Priors so tight that images do not move the poses."""

    name = "held_poses"

    rows: np.ndarray  # (H,) int64, frames
    world_T_rigs: np.ndarray  # (H, 4, 4) float64, their poses

    @property
    def digest(self) -> str:
        """Digest of the frames and poses."""
        return digest_of(self.rows, self.world_T_rigs)

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """A prior on each pose."""
        positions = self.world_T_rigs[:, :3, 3]
        extent = max(float(np.linalg.norm(np.ptp(positions, axis=0))), 1e-12)
        sigmas = np.array([_SIGMA] * 3 + [_SIGMA * extent] * 3)
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph = gtsam.NonlinearFactorGraph()
        for f, world_T_rig in zip(self.rows.tolist(), self.world_T_rigs, strict=True):
            graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), noise))
        return graph
