"""Bundle adjustment through a camera that is solved for: one graph of poses, points and camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from gsba.bundle import pose_variables
from gsba.bundle.adjustment import (
    AdjustmentContext,
    Terms,
    adjust,
    adjust_sighted,
    adjust_sighted_through,
    adjust_through,
)
from gsba.bundle.camera_system import CameraSystem
from gsba.bundle.camera_variables import CameraUnknowns
from gsba.bundle.readout import CameraEstimates
from gsba.bundle.stitching import with_noise_of
from gsba.types import Keypoints, Sighted, Solution, Tracks

_SCALE_SIGMA = 1e-3  # of each map's extent about its former one: images leave the scale open, and
# priors of zero on frames' own motion would shrink the map


@dataclass(frozen=True, slots=True)
class CameraView:
    """Observations through a camera that is solved for; an `adjustment.View`."""

    shown: Keypoints  # as pictures show them
    keypoints: Keypoints  # these keypoints as rays of the camera so far
    cameras: CameraEstimates
    timestamps: np.ndarray  # (F,) seconds

    @classmethod
    def of(cls, shown: Keypoints, cameras: CameraEstimates, timestamps: np.ndarray) -> "CameraView":
        """The view of keypoints, as pictures show them, through a known camera."""
        return cls(shown, cameras.cameras.seen(shown), cameras, timestamps)

    def with_noise_of(self, keypoints: Keypoints) -> "CameraView":
        """The view with the noise of other keypoints of the same rows."""
        shown = with_noise_of(self.shown, keypoints)
        return replace(self, shown=shown, keypoints=self.cameras.cameras.seen(shown))

    def terms(
        self, solved: Solution, noise: float, context: AdjustmentContext
    ) -> tuple[Terms, Callable[[gtsam.Values], "CameraView"]]:
        """Poses and camera as variables of one graph."""
        cameras = self.cameras
        if noise <= solved.noise:  # under wide gates next to nothing contradicts a gyro
            cameras = CameraSystem(solved, self.shown, cameras, self.timestamps, context).prepared()
        unknowns = CameraUnknowns.of(cameras, solved.world_T_rigs, self.timestamps, context)
        terms = context.terms(solved)
        terms.values.insert(unknowns.values)
        graph = gtsam.NonlinearFactorGraph(terms.graph)
        graph.push_back(unknowns.graph)
        poses, maps = solved.world_T_rigs, context.maps
        graph.push_back(pose_variables.fixed_scale(poses, maps, _SCALE_SIGMA))
        block = unknowns.block(solved.landmarks, self.shown, noise, curved=True)

        def after(values: gtsam.Values) -> "CameraView":
            found = unknowns.estimate(values)
            seen = found.cameras.seen(self.shown)
            return replace(self, keypoints=seen, cameras=found)

        return replace(terms, graph=graph, blocks=(block, *terms.blocks)), after


def solve_with_camera(
    tracks: Tracks,
    shown: Keypoints,
    cameras: CameraEstimates,
    timestamps: np.ndarray,
    start: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
    final: bool = True,
) -> tuple[Solution, CameraEstimates]:
    """Solve for poses, points and the parts of a camera that were taken, in one graph.

    The last round, of the tightest gate, is of poses and points alone.

    Args:
        shown: keypoints as pictures show them.
        cameras: to start from; what it leaves out (a readout, axes, raw lenses) is left out.
        timestamps: (F,) seconds.
        start, context, gates, final: see `adjustment.adjust`.
    """
    wide, last = _split(gates)
    view = CameraView.of(shown, cameras, timestamps)

    def adjust_once(so_far: Solution, seen: CameraView, gate: float) -> tuple[Solution, CameraView]:
        return adjust_through(seen, tracks, so_far, context, (gate,), final)

    found, view = _settled(start, view, wide, adjust_once)
    solved = adjust(tracks, view.keypoints, found, context, last, final)
    return replace(solved, rounds=found.rounds + solved.rounds), view.cameras


def solve_sighted_with_camera(
    sighted: Sighted,
    cameras: CameraEstimates,
    timestamps: np.ndarray,
    before: Solution,
    context: AdjustmentContext,
    gates: Sequence[float],
) -> tuple[Solution, Keypoints, CameraEstimates]:
    """As `solve_with_camera`, of aligned and former observations, as `adjust_sighted` takes them.

    Args:
        sighted: observations as pictures show them.

    Returns:
        The solution, the keypoints with the noise that they turned out to have, and the camera.
    """
    wide, last = _split(gates)
    view = CameraView.of(sighted.keypoints, cameras, timestamps)

    def adjust_once(so_far: Solution, seen: CameraView, gate: float) -> tuple[Solution, CameraView]:
        return adjust_sighted_through(seen, sighted, so_far, context, (gate,))

    found, view = _settled(before, view, wide, adjust_once)
    seen = replace(sighted, keypoints=view.keypoints)
    solved, keypoints = adjust_sighted(seen, found, context, last)
    solved = replace(solved, rounds=found.rounds + solved.rounds)
    return solved, view.with_noise_of(keypoints).shown, view.cameras


def _settled(
    start: Solution,
    view: CameraView,
    gates: Sequence[float],
    adjust_once: Callable[[Solution, CameraView, float], tuple[Solution, CameraView]],
) -> tuple[Solution, CameraView]:
    """Solve for the camera under each gate until it takes in what it was solved with.

    Few observations, of near points that both lenses see, tell how far apart the lenses are. Under
    a wrong distance the gate leaves them out, and what is left confirms it.
    """
    solved, rounds = start, ()
    for gate in gates:
        for _ in range(8):  # of a round; three to six settle it
            solved, view = adjust_once(solved, view, gate)
            rounds += solved.rounds
            last = solved.rounds[-1]
            if not last.accepted or last.support == last.observations:
                break
    return replace(solved, rounds=rounds), view


def _split(gates: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
    """Gates of the rounds that solve for the camera, and of the last, of poses and points alone.

    The tightest gate chooses observations by the camera so far, and these would confirm it: raw
    lenses came out worse by them.
    """
    return gates[:-1] or gates, gates[-1:]
