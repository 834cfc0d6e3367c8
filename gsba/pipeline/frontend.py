"""The front end of a run: keypoints as bearings, their matches, and what these say of the start."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from factors.threads import map_in_threads
from gsba import learned
from gsba.camera.cameras import Cameras
from gsba.config import RefineSettings
from gsba.features import detection, extraction
from gsba.features.detection import traits_of
from gsba.features.extraction import FrameFeatures, Search
from gsba.frames import panorama
from gsba.geometry import inverse
from gsba.imu.alignment import Alignment, align, turning_of
from gsba.log import GsbaError, event
from gsba.loop_closure import connectivity, loops
from gsba.loop_closure.loops import Closed
from gsba.matching import correspondences, guided_search, pairs, recovery
from gsba.matching.guided_search import PRIOR_GATE, MatchContext, SearchableFrames
from gsba.matching.recovery import Recovered
from gsba.matching.verification import relative_pose
from gsba.pipeline import inputs, unusable_frames
from gsba.pipeline.acceptance import NoPositions
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Run
from gsba.pipeline.state import MapMatches, ObservedFrames, State
from gsba.store.store import PerFrame
from gsba.trajectory import judgement, steps, turning
from gsba.trajectory.clock import ClockEstimate
from gsba.trajectory.limits import TwoViewLimits
from gsba.types import (
    CoarsePoses,
    Features,
    Keypoints,
    Matches,
    PoseSource,
    VerifiedPairs,
    rows_across,
)

T = TypeVar("T")

CLOSER = "features_closer"  # stage of the features that weak frames get besides
_NUM_STEPS = 3  # compared, spread over the walk
_DRIFT_PER_FRAME = 0.13  # times frames over squared matches of a step: the drift of rendered walks
# of 24 to 48 frames is 0.10 to 0.15 times it; a real one of 11 frames drifts eight times as much
_MAX_GAP_SHARE = 0.1  # largest distance of two positions at one place, part of the path between
# them: the trajectory drifts by less
_MIN_PATH_SHARE = 0.5  # of the whole path, that lies between them at least: shorter detours leave
# the rest open


def extract(run: Run) -> State:
    """Keypoints of all frames, the first state of a run; where its map is expected to be weak, as
    many as weak frames get. UnusableFramesError: see `unusable_frames`."""
    drift, known = expected_drift(run, _search(run, run.settings))
    more = drift > run.settings.weak_frames.max_drift
    event("features", more=more)
    enlarged = _enlarged(run.settings)
    found = _extract(run, enlarged) if more else _extract(run, run.settings, known=known)
    observed = observe(run, "keypoints", [found] * len(run.frames), "features")
    return unusable_frames.refuse_blank(State.begin(run, replace(observed, more=more)))


def _enlarged(settings: RefineSettings) -> RefineSettings:
    most = settings.weak_frames.max_per_face
    more = {"max_per_face": most, "contrast_threshold": 0.01}  # half of the default elsewhere
    return settings.model_copy(update={"features": settings.features.model_copy(update=more)})


def adopt(run: Run, stored: Sequence[Path]) -> ObservedFrames:
    """Keypoints of all frames from features that other runs have stored, (F,) files."""
    make = learned.make_extractor(run.settings.features, run.weights)
    found = extraction.adopted(run.store, run.frames, run.rig, run.settings.cubemap, make, stored)
    load = FrameFeatures([found] * len(run.frames), run.frames.names)
    keypoints = detection.gather(map(load, range(len(run.frames))), run.store.scratch_folder)
    return _matchable(run, [found] * len(run.frames), detection.on_faces(keypoints, run.rig))


def extract_more(state: State, weak: np.ndarray) -> State:
    """More keypoints at some frames (F,) bool, and those of the others as they were."""
    run, before = state.run, state.observed
    found = _extract(run, _enlarged(run.settings), CLOSER, weak)
    each = [found if more else old for more, old in zip(weak, before.features, strict=True)]
    observed = observe(run, "keypoints_closer", each, CLOSER)
    observed = observed.through(before.cameras)
    return replace(state, observed=observed, map=replace(state.map, observed=observed.shown))


def _extract(
    run: Run,
    settings: RefineSettings,
    name: str = "features",
    chosen: np.ndarray | None = None,
    known: Mapping[str, Features] | None = None,
) -> PerFrame[Features]:
    files = [path for stage, path in run.weights.items() if stage == "features"]
    return extraction.extract(run.store, _search(run, settings), files, name, chosen, known)


def _search(run: Run, settings: RefineSettings) -> Search:
    make = learned.make_extractor(settings.features, run.weights)
    return Search(run.frames, run.rig, settings, make)


def observe(run: Run, name: str, found: Sequence[PerFrame[Features]], stage: str) -> ObservedFrames:
    """Features of each frame (F,), ready to be matched; `stage`: the last one they are of."""
    frames = run.frames
    load = FrameFeatures(found, frames.names)

    def gather() -> Keypoints:
        return detection.gather(map(load, range(len(frames))), run.store.scratch_folder)

    keypoints = run.store.stage(name, None, gather, Keypoints, [*run.latest, stage])
    run.latest[:] = [name]
    return _matchable(run, found, keypoints)


def _matchable(
    run: Run, found: Sequence[PerFrame[Features]], keypoints: Keypoints
) -> ObservedFrames:
    """Features (F,) and keypoints of a run's frames, with the means to match them."""
    settings, load = run.matching_settings, FrameFeatures(found, run.frames.names)
    context = MatchContext(
        SearchableFrames(load),
        SearchableFrames(load, settings.pairs.strongest_per_face),
        keypoints,
        settings,
        run.store.workers,
        learned.make_matcher(settings, run.weights, run.rig),
        Cameras.plain(run.frames),
    )
    return ObservedFrames(tuple(found), keypoints, context)


def of_recording(state: State, number: int) -> State:
    """The first state of one recording, from the first state of all recordings of a run."""
    run = state.run.of_recording(number)
    rows = state.run.frames.recordings[state.run.evidence.recordings[number].name]
    first, last = int(rows[0]), int(rows[-1])
    features = state.observed.features[first : last + 1]
    keypoints = state.observed.shown.of_frames(rows)
    return State.begin(run, _matchable(run, features, keypoints))


def match_neighbours(state: State) -> State:
    """Verified matches of frames next to one another in time, the clock set right first, unless
    several trajectories may have clocks of their own. GsbaError if a trajectory turns otherwise
    than the images."""
    run, prior, trajectories = state.run, state.prior, state.run.evidence.trajectories
    state = _match_neighbours(state, "neighbours")
    if len(trajectories) != 1 or prior.absent or run.settings.read.clock == "given":
        return state
    (trajectory,), times = trajectories, run.frames.timestamps
    context, near = state.observed.context, state.verified

    def compute() -> ClockEstimate:
        return recovery.check_clock(context, near, prior.coarse, times, trajectory)

    key = [trajectory.timestamps.tolist(), trajectory.world_T_rigs.tolist()]
    estimate = run.stage("clock", key, compute, ClockEstimate)
    if estimate.verdict != "corrected":
        return replace(state, prior=replace(prior, clock=estimate))
    settled = run.settings.read.model_copy(update={"clock_offset_s": 0.0})
    settings = run.settings.model_copy(update={"read": settled})
    coarse = inputs.coarse_poses(run.frames, [estimate.clock.on_frames(trajectory)], settings)
    state = state.start_from(replace(Prior.of(coarse), clock=estimate))
    return _match_neighbours(state, "neighbours_on_time")


def _match_neighbours(state: State, name: str) -> State:
    if state.prior.absent:
        return state.with_verified(VerifiedPairs.none())
    run, context, prior = state.run, state.observed.context, state.prior

    def compute() -> VerifiedPairs:
        found = correspondences.match_neighbours(context, prior.start())
        return recovery.unless_misguided(context, found, prior.coarse, run.frames.timestamps)

    return state.with_verified(run.stage(name, run.matching_key(), compute, VerifiedPairs))


def check_steps(state: State) -> Recovered:
    """Neighbours with and without the trajectory's guidance, and its steps by these; GsbaError if
    images contradict most of it."""
    run, prior, times = state.run, state.prior, state.run.frames.timestamps
    context = state.observed.context
    compute = partial(recovery.recover, context, state.verified, prior.coarse, times)
    return run.stage("steps", [run.matching_key(), run.settings.priors], compute, Recovered)


def judge_trajectory(state: State, found: Recovered) -> State:
    """The trajectory without what images contradict, as `check_steps` has found; neighbours once
    more where it misled. NoPositions if neighbours show neither a way nor a turn, GsbaError if none
    match."""
    run, prior = state.run, state.prior
    near, trust, coarse = found.neighbours, found.trust, found.coarse
    if len(near.matches.pairs) == 0:
        raise GsbaError(
            f"no two neighbouring frames match ({near.counts.received} pairs, with and "
            f"without the trajectory): {_hindrance(run)}"
        )
    if coarse.absent:
        coarse = replace(coarse, world_T_rigs=trust.world_T_rigs)
        if not (trust.turning_only or np.isfinite(near.direction_sigmas).any()):
            seen, num = np.count_nonzero(~trust.unseen_steps), len(trust.unseen_steps)
            raise NoPositions(
                f"{seen} of {num} pairs of neighbouring frames match, by so little that they show "
                f"neither a way nor a turn on the spot: {_hindrance(run)}"
            )
    prior = replace(prior, coarse=coarse, trust=trust, joints=found.joints)
    return state.begun(prior, near)


def align_gyro_to_neighbours(state: State) -> State:
    """Constraints on the frames' turning from a gyro, aligned to how neighbours turn in images."""
    readings, times = state.run.evidence.imu, state.run.frames.timestamps
    if readings is None:
        return state
    seen = steps.image_steps(state.verified, state.observed.keypoints)

    def compute() -> Alignment:
        return align(times, seen.f_T_nexts[:, :3, :3], seen.verified, readings)

    found = state.run.stage("imu", readings.digest, compute, Alignment)
    turning = None if found.reason else turning_of(readings, found, times)
    return replace(state, prior=replace(state.prior, gyro=found, turning=turning))


def align_gyro_to_map(state: State, name: str, *, with_noise: bool = True) -> State:
    """The gyro aligned anew, to the map's poses, which are better than those before.

    Args:
        state: of the run; it stays as it is where no gyro is believed.
        with_noise: measure the gyro's noise, too. Poses have followed it by as much as it was
            believed: the noise that they leave is measured once where they have become much better.
    """
    prior, times = state.prior, state.run.frames.timestamps
    readings, former = state.run.evidence.imu, prior.gyro
    if readings is None or former is None or former.reason:
        return state
    rotations = state.solution.world_T_rigs[:, :3, :3]
    turns = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]

    def compute() -> Alignment:
        return align(times, turns, ~prior.trust.unseen_steps, readings, former)

    found = state.run.stage(name, readings.digest, compute, Alignment)
    if found.reason:
        return state
    if not with_noise:
        found = replace(found, noise=former.noise)
    turning = turning_of(readings, found, times)
    return replace(state, prior=replace(prior, gyro=found, turning=turning))


def prove_turn(state: State) -> State | None:
    """The state before a map of rotations alone, of a camera whose positions images do not
    determine; None = that it turned on the spot is not proved either.

    Frames one, two, four, ... apart are matched without any prediction, over the whole sequence: a
    slow walk adds up to parallax over the widest gaps. Neighbours tie frames together; of the wider
    gaps of a long sequence, some pairs suffice.
    """
    run, context, num = state.run, state.observed.context, len(state.run.frames)
    nowhere = np.tile(np.eye(4), (num, 1, 1))
    absent = CoarsePoses(nowhere, np.full(num, PoseSource.NONE, np.uint8), run.coarse.time_offset)

    def compute() -> Recovered:
        chosen = [pairs.adjacent(num, 1)]
        for gap in 2 ** np.arange(1, max(num - 1, 1).bit_length()):
            first = rows_across(num - int(gap), 60)
            chosen.append(np.column_stack([first, first + gap]))
        found = recovery.match_anywhere(context, np.concatenate(chosen).astype(np.int32))
        verify = TwoViewLimits.of(run.settings)
        most = turning.MAX_HAND_PARALLAX_RAD
        turn = turning.prove(found, context.keypoints, verify, most)
        seen, none = steps.image_steps(found, context.keypoints), np.zeros(0)
        trust = judgement.check_steps(absent, seen, none, none, verify, run.settings.priors, turn)
        return Recovered(found, trust, absent)

    found = run.stage("turn", run.matching_key(), compute, Recovered)
    if not found.trust.turning_only:
        return None
    return state.begun(replace(state.prior, coarse=absent, trust=found.trust), found.neighbours)


def drop_implausible_steps(state: State) -> State:
    """The state before the map, without matches over steps that have a less plausible length in the
    map than in the trajectory; the same state if there are none.

    The trajectory gives these steps, unless images confirm elsewhere how the map goes on there.
    """
    run, prior, poses = state.run, state.prior, state.solution.world_T_rigs
    coarse, times = prior.coarse, run.frames.timestamps
    limits = TwoViewLimits.of(run.settings).max_length_ratio, run.settings.priors.translation
    wrong = judgement.implausible_steps(coarse, prior.trust, poses, times, *limits)
    if not wrong.any():
        return state
    near = steps.without_steps(state.verified, set(np.flatnonzero(wrong).tolist()))
    trust = judgement.without_steps(coarse, prior.trust, wrong)
    return state.begun(replace(prior, trust=trust), near)


def _hindrance(run: Run) -> str:
    """What keeps frames from matching, as far as their pixels tell."""
    level = panorama.bright_level(run.greys)
    if level < 32:
        return (
            f"they are very dark (99 % of their pixels at or below {level} of 255): make them "
            "brighter; 12 bits in a 16-bit PNG must be scaled up to 16"
        )
    return "frames must follow one another closely and show texture"


def match_along_epipolars(state: State, name: str = "adjacent") -> State:
    """Matches of neighbours in time along their solved epipolar lines, for those before."""
    find, maps = correspondences.match_along_epipolars, state.maps_of_images()
    found = _matched(state, name, Matches, find, maps)
    return replace(state, matches=replace(state.matches, neighbours=found))


def match_across(state: State, parts: np.ndarray) -> State:
    """Verified matches of frames whose parts (F,) images joined; others between these are
    dropped."""
    merged, find = state.prior.merged, correspondences.match_across
    assert merged is not None
    found = _matched(state, "across", VerifiedPairs, find, parts, merged.met).matches
    return replace(state, matches=replace(state.matches.within(parts), across=found))


def match_known_points(state: State, name: str, loops_closed: bool = True) -> State:
    """Matches of the map's points in frames further apart, for all but those of neighbours."""
    found = _matched(state, name, Matches, correspondences.match_known_points, loops_closed)
    return replace(state, matches=MapMatches(state.matches.neighbours, known_points=found))


def match_known_points_across(state: State, parts: np.ndarray, name: str) -> State:
    """Matches of the map's points in frames of another part (F,), for those across before."""
    found = _matched(state, name, Matches, correspondences.match_known_points_across, parts)
    return replace(state, matches=replace(state.matches, across=found))


def _matched(
    state: State, name: str, returns: type[T], find: Callable[..., T], *given: object
) -> T:
    """Matches that `find` gives of the state's frames under its poses, stored as a stage."""
    run, compute = state.run, partial(find, state.observed.context, state.solution, *given)
    return run.stage(name, run.matching_key(), compute, returns)


def close_loops(state: State) -> State:
    """Matches of places met again, and the map, bent first where drift had hidden them."""
    find = correspondences.match_loops
    near = _matched(state, "loops", VerifiedPairs, find)
    bent = _meet_places(state, near)
    if bent is not state:
        near = _matched(bent, "loops2", VerifiedPairs, find)
    return replace(bent, matches=replace(bent.matches, loops=near.matches))


def _meet_places(state: State, near: VerifiedPairs) -> State:
    """The map bent so that places met again meet, where guided search could not reach them."""
    run, prior, trust = state.run, state.prior, state.prior.trust
    unseen = trust.unseen_steps if prior.merged is None else np.zeros_like(trust.unseen_steps)
    pairs = near.matches.pairs
    if len(pairs) and connectivity.parted(pairs, ~unseen) is None:
        return state
    closed = _matched(state, "places", Closed, loops.close, unseen, run.store.scratch_folder)
    if len(closed.pairs) == 0:
        return state
    # Places met again know better than a step that no image shows.
    trust = replace(trust, false_steps=trust.false_steps | unseen)
    return replace(state, prior=replace(prior, trust=trust)).with_solution(closed.solved)


def expected_drift(run: Run, search: Search) -> tuple[float, dict[str, Features]]:
    """Drift to be expected before frames are searched, part of the path; 0 where nothing foretells
    it; and keypoints of the frames compared, by name: none if an earlier call compared them."""
    settings, num = run.settings, len(run.frames)
    usual = settings.features.extractor == "sift" and settings.matching.matcher == "guided"
    if settings.weak_frames.mode != "auto" or not usual or num < 2 * _NUM_STEPS:
        return 0.0, {}
    coarse = run.coarse
    if run.evidence.recordings or coarse.segments is not None or coarse.absent:
        return 0.0, {}
    if comes_back(coarse.world_T_rigs[:, :3, 3]):
        return 0.0, {}
    found = dict[str, Features]()
    first = np.linspace(0, num - 2, _NUM_STEPS).astype(int)
    steps = np.column_stack([first, first + 1])

    def compute() -> float:
        found.update(search.of(np.unique(steps).tolist()))
        return _DRIFT_PER_FRAME * num / max(_matches(run, found, steps), 1.0) ** 2

    key = [run.matching_key(), settings.features, settings.cubemap]
    drift = run.store.stage("expected_drift", key, compute, float, run.latest)
    return drift, found


def _matches(run: Run, found: Mapping[str, Features], steps: np.ndarray) -> float:
    """Median number of verified matches of steps (S, 2) between frames, by strong keypoints."""

    def load(frame: int) -> Features:
        return found[run.frames.names[frame]]

    settings, poses = run.matching_settings, run.coarse.world_T_rigs
    chance = PRIOR_GATE.chance(np.deg2rad(TwoViewLimits.of(settings).max_error_deg))
    frames = SearchableFrames(load, settings.pairs.strongest_per_face)

    def verified(step: int) -> int:
        f0, f1 = steps[step].tolist()
        f0_T_f1 = inverse(poses[f0]) @ poses[f1]
        rows = guided_search.guided(frames, (f0, f1), f0_T_f1, PRIOR_GATE, traits_of(settings))
        rays = load(f0).bearings_rig[rows[:, 0]], load(f1).bearings_rig[rows[:, 1]]
        pose = relative_pose(*rays, TwoViewLimits.of(settings), settings.seed, chance)
        return 0 if pose is None else int(np.count_nonzero(pose.inliers))

    return float(np.median(list(map_in_threads(verified, len(steps), run.num_threads))))


def comes_back(positions: np.ndarray) -> bool:
    """True if a path (F, 3) returns to a place after at least half of its length, or does not
    move."""
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    if not along[-1] > 0:
        return True
    num = len(positions)
    chosen = rows_across(num, 500)
    places, along = positions[chosen], along[chosen]
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    between = np.abs(along[:, None] - along)
    met = (distances < _MAX_GAP_SHARE * between) & (between > _MIN_PATH_SHARE * along[-1])
    return bool(met.any())
