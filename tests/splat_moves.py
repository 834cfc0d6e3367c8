"""Poses that a splat is to correct, and moves of them that help or harm."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from tiny_run import SETTINGS, Case

from gsba.bundle.adjustment import AdjustmentContext
from gsba.bundle.families import Bearings, Families
from gsba.bundle.trajectory_prior import TrajectoryPrior
from gsba.config import RefineSettings
from gsba.frames import cubemap
from gsba.splat import refinement
from gsba.splat.refinement import SplatResult
from gsba.store.store import load_stage
from gsba.types import FrameSet, Keypoints, Solution

Given = tuple[FrameSet, Keypoints, Solution]


def settings_for(factors: tuple[str, ...] = ("bearing", "splat"), **splat) -> RefineSettings:
    """Small faces."""
    chosen = {"factors": factors, "splat": {"sizes": (24,), "backend": "cpu", **splat}}
    return RefineSettings.model_validate({**SETTINGS.model_dump(), **chosen})


def shorten(patch: pytest.MonkeyPatch, **changes: float) -> None:
    """Few steps, one move, a held-out frame in four; or other constants of the refinement."""
    few = {"first_steps": 60, "steps": 20, "max_moves": 1, "held_out_every": 4}
    for name, value in {**few, **changes}.items():
        patch.setattr(refinement, f"_{name.upper()}", value)


def spoiled(case: Case, degrees: float, distance: float, noise: float, seed: int = 0) -> Given:
    """Frames, keypoints and a solution whose poses are off and whose observations are doubted."""
    solved, keypoints = load_stage(case.out, "aligned2", tuple[Solution, Keypoints])
    rng, poses = np.random.default_rng(seed), solved.world_T_rigs.copy()
    sigmas = np.repeat([np.deg2rad(degrees), distance], 3)
    for f in range(1, len(poses)):
        poses[f] = gtsam.Pose3(poses[f]).retract(rng.normal(0, sigmas)).matrix()
    start = replace(solved, world_T_rigs=poses, noise=noise * solved.noise)
    return case.result.frames, keypoints, start


def run(case: Case, given: Given, settings: RefineSettings, **options) -> SplatResult:
    priors = TrajectoryPrior(case.result.coarse.world_T_rigs, settings.priors)
    rig = cubemap.rig_for(case.result.frames.format, settings.cubemap)
    return refinement.refine(
        *given, AdjustmentContext(Families((Bearings(), priors)), rig, settings, 2), **options
    )


Harm = Callable[[np.ndarray, np.random.Generator], np.ndarray]  # of steps (F, 6), tangents


def _sizes(steps: np.ndarray) -> np.ndarray:
    """Root mean square (6,) of the turns, then of the shifts."""
    return np.repeat(np.sqrt(np.mean(steps.reshape(-1, 2, 3) ** 2, axis=(0, 2))), 3)


def _half(steps: np.ndarray, _: np.random.Generator) -> np.ndarray:
    order = np.argsort(np.linalg.norm(steps / _sizes(steps), axis=1))
    signs = np.ones(len(steps))
    signs[order[len(steps) // 2 :]] = -1
    return signs[:, None] * steps


def _noise(steps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return _sizes(steps) * rng.standard_normal(steps.shape)


HARMS: dict[str, Harm] = {
    "reversed": lambda steps, _: -steps,
    "2.5 times too far": lambda steps, _: 2.5 * steps,
    "the further half reversed": _half,
    "noise of its size": _noise,
}


def harmed(real: Callable, harm: Harm, seed: int) -> Callable:
    """A joint move, `splat_refine._Turns._moved`, made harmful."""

    def moved(self, gaussians, world_T_rigs: np.ndarray):
        found, result = real(self, gaussians, world_T_rigs)
        before = [gtsam.Pose3(pose) for pose in world_T_rigs]
        pairs = zip(before, found, strict=True)
        steps = np.stack([pose.localCoordinates(gtsam.Pose3(after)) for pose, after in pairs])
        steps = harm(steps, np.random.default_rng([seed, 1]))  # not the errors that it is to mend
        pairs = zip(before, steps, strict=True)
        return np.stack([pose.retract(step).matrix() for pose, step in pairs]), result

    return moved
