"""The front end of a run: keypoints as bearings, their matches, and what these say of the start."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from gsba import learned
from gsba.camera.lens import Lenses
from gsba.config import RefineSettings
from gsba.features import detection, extraction
from gsba.features.extraction import FrameFeatures
from gsba.frames import panorama
from gsba.imu.alignment import Alignment, align, turning_of
from gsba.log import GsbaError
from gsba.loop_closure import connectivity, loops
from gsba.loop_closure.loops import Closed
from gsba.loop_closure.merged_map import Registered
from gsba.matching import correspondences, recovery
from gsba.matching.guided_search import MatchContext, SearchableFrames
from gsba.matching.recovery import Recovered
from gsba.pipeline import inputs
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.store.store import PerFrame
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.steps import image_steps
from gsba.types import Features, Keypoints, Matches, Solution, Trajectory, VerifiedPairs

_DARK = 32  # of 255


@dataclass(frozen=True, slots=True)
class ObservedFrames:
    """What was found in the frames."""

    features: tuple[PerFrame[Features], ...]  # (F,) stage that holds each frame's
    shown: Keypoints  # of all frames, where pictures show them
    context: MatchContext  # what matches them
    lenses: Lenses = field(default_factory=Lenses)  # that its keypoints are seen through

    @property
    def keypoints(self) -> Keypoints:
        """Of all frames, as rays of the lenses."""
        return self.context.keypoints

    def through(self, lenses: Lenses) -> "ObservedFrames":
        """The same, its keypoints as rays that start at these lenses."""
        context = replace(self.context, keypoints=lenses.seen(self.shown), lenses=lenses)
        return replace(self, context=context, lenses=lenses)


def extract(run: Run) -> ObservedFrames:
    """Keypoints of all frames."""
    found = _extract(run, run.settings)
    return _see(run, "keypoints", [found] * len(run.frames), "features")


def extract_more(run: Run, seen: ObservedFrames, weak: np.ndarray) -> ObservedFrames:
    """More keypoints at some frames (F,) bool, and those of the others as they were."""
    more = run.settings.weak_frames.model_dump(include={"max_per_face", "contrast_threshold"})
    enlarged = run.settings.features.model_copy(update=more)
    settings = run.settings.model_copy(update={"features": enlarged})
    found = _extract(run, settings, "features_closer", weak)
    each = [found if more else before for more, before in zip(weak, seen.features, strict=True)]
    return _see(run, "keypoints_closer", each, "features_closer").through(seen.lenses)


def _extract(
    run: Run, settings: RefineSettings, name: str = "features", chosen: np.ndarray | None = None
) -> PerFrame[Features]:
    make = learned.make_extractor(settings.features, run.weights)
    files = [path for stage, path in run.weights.items() if stage == "features"]
    return extraction.extract(run.store, run.frames, run.rig, settings, make, files, name, chosen)


def _see(run: Run, name: str, found: Sequence[PerFrame[Features]], stage: str) -> ObservedFrames:
    """Features of each frame (F,), ready to be matched; `stage`: the last one they are of."""
    frames, settings = run.frames, run.matching_settings

    load = FrameFeatures(found, frames.names)

    def gather() -> Keypoints:
        return detection.gather(map(load, range(len(frames))))

    keypoints = run.chain.stage(name, None, gather, Keypoints, also=[stage])
    context = MatchContext(
        SearchableFrames(load),
        SearchableFrames(load, settings.pairs.strongest_per_face),
        keypoints,
        settings,
        run.store.workers,
        learned.make_matcher(settings, run.weights, run.rig.size),
    )
    return ObservedFrames(tuple(found), keypoints, context)


def match_neighbours(
    run: Run, seen: ObservedFrames, prior: Prior, given: Sequence[Trajectory]
) -> tuple[Prior, VerifiedPairs]:
    """Verified matches of frames next to one another in time, the clock set right first.

    Args:
        run, seen, prior: of the run; the start is at the right times afterwards.
        given: all entries of the trajectory; of several, each piece may have a clock of its own,
            and all are taken as they are.

    Raises:
        GsbaError: a trajectory that turns otherwise than the images.
    """
    near = _match_neighbours(run, seen, prior, "neighbours")
    if len(given) != 1 or prior.absent or run.settings.read.clock == "given":
        return prior, near
    (trajectory,), times = given, run.frames.timestamps

    def compute() -> ClockEstimate:
        return recovery.check_clock(seen.context, near, prior.coarse, times, trajectory)

    key = [trajectory.timestamps.tolist(), trajectory.world_T_rigs.tolist()]
    estimate = run.stage("clock", key, compute, ClockEstimate)
    if estimate.verdict != "corrected":
        return replace(prior, clock=estimate), near
    settled = run.settings.read.model_copy(update={"clock_offset_s": 0.0})
    settings = run.settings.model_copy(update={"read": settled})
    coarse = inputs.coarse_poses(run.frames, [estimate.clock.on_frames(trajectory)], settings)
    prior = replace(Prior.of(coarse), clock=estimate)
    return prior, _match_neighbours(run, seen, prior, "neighbours_on_time")


def _match_neighbours(run: Run, seen: ObservedFrames, prior: Prior, name: str) -> VerifiedPairs:
    if prior.absent:
        return VerifiedPairs.none()
    compute = partial(correspondences.match_neighbours, seen.context, prior.start())
    return run.stage(name, run.matching_key(), compute, VerifiedPairs)


def judge_trajectory(
    run: Run, seen: ObservedFrames, prior: Prior, near: VerifiedPairs
) -> tuple[Prior, VerifiedPairs]:
    """The trajectory without what images contradict; neighbours once more where it misled.

    Raises:
        GsbaError: images contradict most of the trajectory, or match nowhere.
    """
    times = run.frames.timestamps
    compute = partial(recovery.recover, seen.context, near, prior.coarse, times)
    key = [run.matching_key(), run.settings.priors]
    found = run.stage("steps", key, compute, Recovered)
    near, trust, coarse = found.neighbours, found.trust, found.coarse
    if len(near.matches.pairs) == 0:
        raise GsbaError(
            f"no two neighbouring frames match ({near.counts.received} pairs, with and "
            f"without the trajectory): {_hindrance(run)}"
        )
    parts = connectivity.parted(near.matches.pairs, trust.held_steps)
    prior = replace(prior, coarse=coarse, trust=trust, joints=found.joints, parts=parts)
    if prior.absent:
        coarse = replace(coarse, world_T_rigs=trust.world_T_rigs)
    return replace(prior, coarse=coarse), near


def align_imu(run: Run, seen: ObservedFrames, prior: Prior, near: VerifiedPairs) -> Prior:
    """What a gyro says of the frames' turning, found from how neighbours turn."""
    readings, times = run.imu, run.frames.timestamps
    if readings is None:
        return prior
    steps = image_steps(near, seen.keypoints)

    def compute() -> Alignment:
        return align(times, steps.f_T_nexts[:, :3, :3], steps.verified, readings)

    found = run.stage("imu", readings.digest, compute, Alignment)
    if found.reason:
        return replace(prior, gyro=found)
    return replace(prior, gyro=found, turning=turning_of(readings, found, times))


def _hindrance(run: Run) -> str:
    """What keeps frames from matching, as far as their pixels tell."""
    level = panorama.bright_level(run.greys)
    if level < _DARK:
        return (
            f"they are very dark (99 % of their pixels at or below {level} of 255): make them "
            "brighter; 12 bits in a 16-bit PNG must be scaled up to 16"
        )
    return "frames must follow one another closely and show texture"


def match_along_epipolars(
    run: Run, seen: ObservedFrames, solved: Solution, name: str = "adjacent"
) -> Matches:
    """Matches of neighbours in time along their solved epipolar lines."""
    compute = partial(correspondences.match_along_epipolars, seen.context, solved)
    return run.stage(name, run.matching_key(), compute, Matches)


def match_across(run: Run, seen: ObservedFrames, merged: Registered, parts: np.ndarray) -> Matches:
    """Verified matches of frames whose parts (F,) of the map were joined by images."""
    given = seen.context, merged.solved, parts, merged.met
    compute = partial(correspondences.match_across, *given)
    return run.stage("across", run.matching_key(), compute, VerifiedPairs).matches


def match_known_points(
    run: Run, seen: ObservedFrames, solved: Solution, name: str, loops_closed: bool = True
) -> Matches:
    """Matches of solved points in frames further apart."""
    compute = partial(correspondences.match_known_points, seen.context, solved, loops_closed)
    return run.stage(name, run.matching_key(), compute, Matches)


def close_loops(
    run: Run, seen: ObservedFrames, prior: Prior, solved: Solution
) -> tuple[Prior, Solution, Matches]:
    """Matches of places met again, and the map, bent first where drift had hidden them."""
    near = _match_loops(run, seen, solved, "loops")
    prior, bent = _meet_places(run, seen, prior, solved, near)
    if bent is not solved:
        near = _match_loops(run, seen, bent, "loops2")
    return prior, bent, near.matches


def _match_loops(run: Run, seen: ObservedFrames, solved: Solution, name: str) -> VerifiedPairs:
    """Verified matches of frames that met the same place again."""
    compute = partial(correspondences.match_loops, seen.context, solved)
    return run.stage(name, run.matching_key(), compute, VerifiedPairs)


def _meet_places(
    run: Run, seen: ObservedFrames, prior: Prior, solved: Solution, near: VerifiedPairs
) -> tuple[Prior, Solution]:
    """The map bent so that places met again meet, where guided search could not reach them."""
    trust = prior.trust
    unseen = trust.unseen_steps if prior.merged is None else np.zeros_like(trust.unseen_steps)
    pairs = near.matches.pairs
    if loops.connected(unseen, pairs) and len(pairs):
        return prior, solved
    compute = partial(loops.close, seen.context, solved, unseen)
    closed = run.stage("places", run.matching_key(), compute, Closed)
    if len(closed.pairs) == 0:
        return prior, solved
    # Places met again know better than a step that no image shows.
    trust = replace(trust, false_steps=trust.false_steps | unseen)
    return replace(prior, trust=trust), closed.solved
