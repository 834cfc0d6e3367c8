"""The trajectory prior: a family of relative priors, weak absolute ones, and a held first pose."""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import RobustLoss
from gsba.bundle.families import Family, MapSnapshot, digest_of
from gsba.bundle.pose_variables import X, pose_noise
from gsba.config import PriorSettings
from gsba.geometry import extent_of, relative_steps, typical_length
from gsba.types import GyroConstraints

LOSS_SIGMAS = 2.0  # Cauchy scale: limits the pull of wrong measurements
_LOSS = RobustLoss("cauchy", LOSS_SIGMAS)


@dataclass(frozen=True, slots=True)
class StepNoise:
    """Standard deviations of the trajectory's steps between frames."""

    rotation: float  # radians, per axis
    direction: float  # of motion's direction, radians, per axis
    length: float  # of the step's length, relative


@dataclass(frozen=True, slots=True)
class TrajectoryPrior(Family):
    """The poses of a trajectory as priors, as far as images confirm them.

    Where another family holds the gauge, the first pose is as free as the map is large, and
    absolute priors are weaker.
    """

    name = "trajectory"

    world_T_rigs: np.ndarray  # (F, 4, 4) float64, in the frame and scale that the result keeps
    settings: PriorSettings  # noise of steps and poses, loss
    false_steps: np.ndarray | None = None  # (F - 1,) bool, steps without a prior; None = all have
    # one
    false_frames: np.ndarray | None = None  # (F,) bool, frames without an absolute prior; None =
    # all have one
    first: np.ndarray | None = None  # (4, 4) where the first pose is held; None = where the
    # trajectory has it
    noise: StepNoise | None = None  # of steps with a prior, as others showed it; None = as in the
    # settings

    @property
    def digest(self) -> str:
        """Digest of the trajectory and of its noise."""
        flags = self.false_steps, self.false_frames, self.first
        return digest_of(self.world_T_rigs, *flags, repr(self.settings), repr(self.noise))

    def graph(self, snapshot: MapSnapshot) -> gtsam.NonlinearFactorGraph:
        """Priors of steps, of frames, and of the first pose."""
        world_T_rigs, held = self.world_T_rigs, not snapshot.gauge_held
        lengths = np.linalg.norm(np.diff(world_T_rigs[:, :3, 3], axis=0), axis=1)
        typical = typical_length(lengths)
        extent = max(extent_of(world_T_rigs[:, :3, 3]), typical)
        graph = gtsam.NonlinearFactorGraph()
        settings, spread, lengths = self.settings, self.noise, np.maximum(lengths, typical)
        steps = relative_steps(world_T_rigs)
        kept = np.ones(len(steps), bool) if self.false_steps is None else ~self.false_steps
        # steps in a gapless run drift alike
        runs = np.cumsum(np.diff(kept.astype(int), prepend=0) != 0)
        in_a_row = np.bincount(runs, minlength=1)[runs] if len(kept) else runs
        for k in np.flatnonzero(kept).tolist():
            length = float(lengths[k])
            if spread is None:
                rotation, translation = np.deg2rad(settings.rotation_deg), settings.translation
                of_step = _LOSS.noise_model(pose_noise(rotation, translation * length))
            else:
                covariance = in_a_row[k] * _step_covariance(steps[k], length, spread)
                gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
                of_step = _LOSS.noise_model(gaussian)
            graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), gtsam.Pose3(steps[k]), of_step))
        # absolute priors, weaker where another family holds the gauge: they only hold frames that
        # nothing else does
        weaker = 1.0 if held else 10.0
        model = _LOSS.noise_model(pose_noise(weaker * np.deg2rad(30.0), weaker * 0.3 * extent))
        for f, world_T_rig in enumerate(world_T_rigs):
            if self.false_frames is None or not self.false_frames[f]:
                graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), model))
        sigma = 1e-6 if held else 1.0  # of the held first pose: radians, and part of the extent
        noise = pose_noise(sigma, sigma * extent)
        fixed = gtsam.Pose3(world_T_rigs[0] if self.first is None else self.first)
        graph.add(gtsam.PriorFactorPose3(X(0), fixed, noise))
        return graph


def _step_covariance(f_T_next: np.ndarray, length: float, noise: StepNoise) -> np.ndarray:
    """Covariance (6, 6) of a step perturbed on the right; `length` in map units."""
    ahead = f_T_next[:3, :3].T @ f_T_next[:3, 3]
    along = np.outer(ahead, ahead) / max(float(ahead @ ahead), 1e-300)
    covariance = np.diag([noise.rotation**2] * 6)
    across = noise.direction**2 * (np.eye(3) - along)
    covariance[3:, 3:] = length**2 * (noise.length**2 * along + across)
    if not ahead.any():
        covariance[3:, 3:] = (length * noise.length) ** 2 * np.eye(3)
    return covariance


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
        extent = max(extent_of(positions), 1e-12)
        noise = pose_noise(_SIGMA, _SIGMA * extent)
        graph = gtsam.NonlinearFactorGraph()
        for f, world_T_rig in zip(self.rows.tolist(), self.world_T_rigs, strict=True):
            graph.add(gtsam.PriorFactorPose3(X(f), gtsam.Pose3(world_T_rig), noise))
        return graph


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
        free = 1e4 * max(self.extent, 1e-9)  # no translation is measured
        loss = RobustLoss("cauchy", self.loss_sigmas)
        for f in np.flatnonzero(np.isfinite(turning.step_sigmas)).tolist():
            model = loss.noise_model(pose_noise(turning.step_sigmas[f], free))
            step = gtsam.Pose3(gtsam.Rot3.Expmap(turning.steps[f]), np.zeros(3))
            graph.add(gtsam.BetweenFactorPose3(X(f), X(f + 1), step, model))
        return graph

    def report(self, snapshot: MapSnapshot) -> Mapping[str, float]:
        """Share of all steps whose refined rotation agrees with the gyro."""
        from scipy.spatial.transform import Rotation

        rotations, turning = snapshot.world_T_rigs[:, :3, :3], self.turning
        found = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
        off = (found.inv() * Rotation.from_rotvec(turning.steps)).as_rotvec()
        # beyond 3, the robust loss suppresses a step
        limits = 3.0 * np.sqrt(3) * turning.step_sigmas
        near = np.linalg.norm(off, axis=1) < limits
        return {"steps_used": float(np.mean(near & np.isfinite(turning.step_sigmas)))}
