"""The gyro's family: relative rotations of neighbouring frames."""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from gsba.bundle.families import Family, MapSnapshot, digest_of
from gsba.bundle.pose_variables import X
from gsba.types import GyroConstraints

_FREE_EXTENTS = 1e4  # sigma of a step's translation, extents of the map: none is measured
_MAX_RESIDUAL_SIGMAS = 3.0  # of a step; beyond it, the robust loss suppresses the step


@dataclass(frozen=True, slots=True)
class GyroTurns(Family):
    """Rotations between neighbours that a gyro measured, under a Cauchy loss."""

    name = "gyro"

    turning: GyroConstraints  # steps and how well they are known
    extent: float  # of the map, map units
    loss_sigmas: float  # scale of the loss, standard deviations

    @property
    def digest(self) -> str:
        """Digest of the steps and their noise."""
        turning = self.turning
        measured = turning.steps, turning.step_sigmas, turning.rates, turning.rate_sigma
        return digest_of(*measured, self.extent, self.loss_sigmas)

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """A relative prior for each step that was measured."""
        graph, turning = gtsam.NonlinearFactorGraph(), self.turning
        free = _FREE_EXTENTS * max(self.extent, 1e-9)
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(self.loss_sigmas)
        for f in np.flatnonzero(np.isfinite(turning.step_sigmas)).tolist():
            sigmas = np.array([turning.step_sigmas[f]] * 3 + [free] * 3)
            gaussian = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            model = gtsam.noiseModel.Robust.Create(loss, gaussian)
            step = gtsam.Pose3(gtsam.Rot3.Expmap(turning.steps[f]), np.zeros(3))
            graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), step, model))
        return graph

    def report(self, snapshot: MapSnapshot) -> Mapping[str, float]:
        """Share of all steps whose refined rotation agrees with the gyro."""
        from scipy.spatial.transform import Rotation

        rotations, turning = snapshot.world_T_rigs[:, :3, :3], self.turning
        found = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
        off = (found.inv() * Rotation.from_rotvec(turning.steps)).as_rotvec()
        limits = _MAX_RESIDUAL_SIGMAS * np.sqrt(3) * turning.step_sigmas
        near = np.linalg.norm(off, axis=1) < limits
        return {"steps_used": float(np.mean(near & np.isfinite(turning.step_sigmas)))}
