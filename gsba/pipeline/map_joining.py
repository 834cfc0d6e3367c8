"""Finished maps made one: joined where they meet, tied by points of both, and solved together. Only
points that frames of different parts share are new: they replace those of either part that they
are."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsba.bundle.adjustment import ALIGNED_GATES
from gsba.bundle.found_camera import FoundCamera
from gsba.bundle.lens_centres import baseline_of
from gsba.bundle.trajectory_prior import HeldPoses
from gsba.config import RefineSettings
from gsba.features.detection import traits_of
from gsba.geometry import adjoint, inverse
from gsba.localization.run_map import SAME_PLACE_RAD, SAME_PLACE_SIGMAS
from gsba.log import GsbaError
from gsba.loop_closure import connectivity, map_merging
from gsba.loop_closure.map_similarity import Meeting, meetings_of, refined, similarity_covariance
from gsba.loop_closure.merged_map import Registered, carried
from gsba.photometric.alignment import AlignedObservations
from gsba.pipeline import backend, camera, frontend, inputs, patch_rounds
from gsba.pipeline.joint_map import JointMaps, joined_keypoints
from gsba.pipeline.prior import Prior
from gsba.pipeline.run import Evidence, RecordingEvidence, Run
from gsba.pipeline.state import MapMatches, State
from gsba.similarity import Sim3
from gsba.store.store import RunStore
from gsba.trajectory.judgement import StepChecks
from gsba.types import (
    CoarsePoses,
    Keypoints,
    Matches,
    PoseSource,
    RunStart,
    Sighted,
    Solution,
    Tracks,
)

logger = logging.getLogger(__name__)

_MAX_SCALE_SIGMAS = 5.0  # by which two maps' units may contradict the distances of their lenses
_MAX_SCALE_RATIO = 1.15  # and in any case
_NOT_TIED = (
    "the maps meet, but their frames {}: nothing is written; refine all recordings together "
    "(gsba refine A B --out RUN)"
)


class ApartError(GsbaError):
    """Maps that are not joined, however often it is tried."""


def begin(store: RunStore, maps: JointMaps, settings: RefineSettings) -> State:
    """The state of maps that nothing ties together yet."""
    poses = maps.map.solution.world_T_rigs
    start = CoarsePoses(poses, np.full(len(poses), PoseSource.SLAM, np.uint8), 0.0)
    families = tuple(inputs.families_of(maps.frames, settings))
    cameras = _settings_of_cameras(maps, start)
    evidence = Evidence(families=families, recordings=cameras, start=RunStart.EARLIER_RUN)
    run = Run.begin(store, maps.frames, start, settings.with_faint_priors(), evidence)
    observed = frontend.adopt(run, [path for one in maps.runs for path in one.files])
    state = replace(State.begin(run, observed), map=maps.map)
    state = _tied_within(state, maps.parts).through(maps.map.lenses)
    # Matches that tracks consist of: each observation with the next one of its point
    tracks = _by_features(state).landmarks.tracks
    following = np.flatnonzero(tracks.points[1:] == tracks.points[:-1])
    first, second = tracks.frames[following], tracks.frames[following + 1]
    keypoints = np.column_stack([tracks.keypoints[following], tracks.keypoints[following + 1]])
    order = np.lexsort((second, first))
    pairs = np.column_stack([first, second])[order]
    distinct, counts = np.unique(pairs, axis=0, return_counts=True)
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return replace(
        state,
        matches=MapMatches(
            Matches(distinct.astype(np.int32).reshape(-1, 2), offsets, keypoints[order])
        ),
    )


def register(state: State, maps: JointMaps) -> State:
    """Maps moved to where they meet others, as the test of joins confirms; ApartError where two
    meet in a scale that the distances of their lenses contradict."""
    run, solution = state.run, state.solution
    nothing = np.zeros(len(solution.world_T_rigs) - 1, bool)

    def compute() -> Registered:
        given = state.observed.context, _by_features(state), maps.parts, nothing, nothing
        owners = run.frames.recording_of_frame
        return map_merging.merge(*given, run.frames.timestamps, True, owners)

    merged = run.stage("registered", run.matching_key(), compute, Registered)
    for number in range(1, len(maps.runs)):
        frames = int(maps.main_rows(0)[0]), int(maps.main_rows(number)[0])
        if merged.components[frames[0]] == merged.components[frames[1]]:
            for pair in maps.cameras.shared(0, number):
                _check_unit(maps, merged, (0, number), pair)
    poses = merged.solved.world_T_rigs
    moved = carried(solution, poses, merged.scales, merged.moves, merged.offsets)
    state = _with_unit(state, merged.scales, maps.unit_frames())
    return _tied_within(state.with_solution(moved), maps.parts, merged)


@dataclass(frozen=True, slots=True)
class RigidMoves:
    """Similarities that move parts of joined maps as they are, and their covariances."""

    scales: np.ndarray  # (P,) float64, by part: it is moved by scale * R @ x + t
    moves: np.ndarray  # (P, 4, 4) float64, R and t
    covariances: np.ndarray  # (P, 7, 7) float64, [rotation rad, translation, logarithm of the
    # scale], see `SegmentAlignment`; 0 = the part stays, NaN = not known

    def pose_covariances(
        self, own: np.ndarray, world_T_rigs: np.ndarray, stretches: np.ndarray, parts: np.ndarray
    ) -> np.ndarray:
        """Covariances (F, 6, 6) of poses (F, 4, 4) moved by parts (F,), in the new map, from those
        in their own maps, of which a unit has `stretches` (F,) of the new one."""
        turned = world_T_rigs.copy()
        turned[:, :3, 3] -= self.moves[parts, :3, 3]  # what turns and grows under the move
        back = inverse(turned)
        by_move = np.zeros((len(own), 6, 7))
        by_move[:, :, :6] = adjoint(back)
        by_move[:, 3:, 6] = -back[:, :3, 3]
        moved = by_move @ self.covariances[parts] @ np.swapaxes(by_move, 1, 2)
        units = np.repeat(np.column_stack([np.ones(len(own)), stretches]), 3, axis=1)
        return own * units[:, :, None] * units[:, None, :] + moved


def align_rigidly(state: State, parts: np.ndarray) -> RigidMoves:
    """Parts (F,) of joined maps moved, each as it is, by the points that they share with those
    before them; the first part of every map stays."""
    run, merged, num = state.run, state.prior.merged, int(parts.max()) + 1
    assert merged is not None
    matches = _across(state, parts, merged).matches.across
    found = _by_features(state)

    def compute() -> RigidMoves:
        poses = state.solution.world_T_rigs.copy()
        points = found.points_by_keypoint(state.observed.keypoints)
        known = [points[f] for f in range(len(poses))]
        moves, covariances = [Sim3()] * num, np.zeros((num, 7, 7))
        for component in np.unique(merged.components):
            inside = np.unique(parts[merged.components == component]).tolist()
            for part in inside[1:]:
                done = np.isin(parts, [one for one in inside if one < part])
                meetings = _meetings(matches, known, parts == part, done)
                if not meetings:
                    covariances[part] = np.nan
                    continue
                moves[part] = refined(meetings, Sim3(), poses)
                covariances[part] = similarity_covariance(meetings, moves[part], poses)
                rows = np.flatnonzero(parts == part)
                poses[rows] = moves[part].poses(poses[rows])
                for f in rows:
                    known[f] = moves[part].scale * known[f]
        scales = np.array([move.scale for move in moves])
        return RigidMoves(scales, np.array([move.new_T_old for move in moves]), covariances)

    return run.stage("similarities", run.matching_key(), compute, RigidMoves, noted=False)


def moved_rigidly(
    state: State, parts: np.ndarray, rigid: RigidMoves, units: Sequence[int]
) -> State:
    """The state with parts (F,) moved by similarities, each camera in the unit of one of the frames
    `units` (C,)."""
    solution, scales, moves = state.solution, rigid.scales[parts], rigid.moves[parts]
    poses = np.empty_like(solution.world_T_rigs)
    for part in np.unique(parts):
        rows = parts == part
        move = Sim3.of(float(rigid.scales[part]), rigid.moves[part])
        poses[rows] = move.poses(solution.world_T_rigs[rows])
    landmarks = solution.landmarks.moved(scales, moves)
    moved = replace(solution, world_T_rigs=poses, landmarks=landmarks)
    merged = state.prior.merged
    return _tied_within(_with_unit(state, scales, units).with_solution(moved), parts, merged)


def adjust(state: State) -> State:
    """The map adjusted with the observations that it has."""
    solved = _solved(state, _sighted(state), "aligned1")
    return state if solved is None else solved


def _meetings(
    matches: Matches | None, known: Sequence[np.ndarray], outside: np.ndarray, done: np.ndarray
) -> list[Meeting]:
    """Points that frames outside (F,) bool share with frames that are done (F,) bool."""
    if matches is None:
        return []
    first, second = matches.pairs.T
    chosen = (outside[first] & done[second]) | (outside[second] & done[first])
    return meetings_of(known, matches.taken(np.flatnonzero(chosen)), np.flatnonzero(outside))


def hold(state: State, rows: np.ndarray) -> State:
    """The state with the poses of frames (H,) held where they are."""
    run = state.run
    held = HeldPoses(rows, state.solution.world_T_rigs[rows])
    families = run.families.with_members((*run.families.members, held))
    return replace(state, run=replace(run, families=families))


def tie(state: State, parts: np.ndarray) -> State:
    """Joined maps tied by the points that frames of different parts (F,) share, and adjusted;
    ApartError if they share none, or frames lose theirs when adjusted together."""
    merged, run = state.prior.merged, state.run
    assert merged is not None
    state = replace(state, matches=_across(state, parts, merged).matches)
    ties = _crossing(state, parts)
    if not len(ties):
        raise ApartError(_NOT_TIED.format("share no points there"))
    base, shown = _sighted(state), state.observed.shown
    tied = Sighted(shown, np.zeros(len(shown.faces), bool), ties, base.counts)
    everything, order = _together(base, tied)
    everything = replace(everything, normals_rig=None)
    solved = _solved(state, everything, "joined", run.settings.rounds.loops)
    if solved is None:
        raise ApartError(_NOT_TIED.format("lose points when they are adjusted together"))
    if not run.settings.patches.rounds:
        return solved
    sigmas = np.empty(len(order))  # noise of features that are interleaved with observations
    sigmas[order] = solved.map.observed.sigmas_rad
    changed = {"sigmas_rad": sigmas[len(base.aligned) :], "sqrt_infos": None}
    features = replace(state.observed.shown, **changed)
    unread = all(one.readout is None for one in solved.map.cameras)
    poses = replace(state.solution, world_T_rigs=solved.solution.world_T_rigs)
    state = state.with_solution(poses)
    state = state if unread else state.with_cameras(solved.map.estimates())
    return _aligned(state, base, features, parts) or solved


def _aligned(state: State, base: Sighted, features: Keypoints, parts: np.ndarray) -> State | None:
    """Shared points aligned to patches, then all around them, and solved; None = no better."""
    run, rounds = state.run, state.run.settings.patches.rounds
    gate = ALIGNED_GATES[0]
    rays = state.map.rays(features, run.rig)
    placed = state.triangulated(backend.tracks_of(state), rays, gate)
    known = replace(state.solution, landmarks=placed, noise=1.0)
    found = frontend.match_known_points_across(state.with_solution(known), parts, "across2")
    state = replace(state, matches=found.matches)
    start = replace(known, landmarks=state.triangulated(_crossing(state, parts), rays, gate))
    size = traits_of(run.settings).patch_size
    seen = AlignedObservations(features, size, field=state.map.field)
    shared = patch_rounds.observe(state, start, seen, "align1")
    left, before, better = _without_same(base, shared, run.greys.width), state, None
    for n in range(1, rounds + 1):
        if patch_rounds.is_settled(before, state, n):
            break
        if n > 1:
            left, shared = _align_around(state, parts, f"align{n}")
        solved = _solved(state, _together(left, shared)[0], f"aligned{n}")
        if solved is None:
            break
        before, state, better = state, solved, solved
    return better


def _align_around(state: State, parts: np.ndarray, name: str) -> tuple[Sighted, Sighted]:
    """Observations of all other points, and anew those of points that frames at meetings see."""
    solution = state.solution
    landmarks, tracks = solution.landmarks, solution.landmarks.tracks
    meeting = np.unique(tracks.frames[_of_several(tracks, parts)[tracks.points]])
    chosen = np.zeros(tracks.num_points, bool)
    chosen[tracks.points[np.isin(tracks.frames, meeting)]] = True
    known = _sighted(state)
    keypoints = known.keypoints.scaled_noise(solution.noise)
    left = replace(known, keypoints=keypoints, tracks=tracks.of(~chosen))
    around = replace(solution, landmarks=landmarks.of(chosen))
    return left, patch_rounds.observe(state, around, patch_rounds.observations(state), name)


def _solved(
    state: State, sighted: Sighted, name: str, gates: Sequence[float] | None = None
) -> State | None:
    """Adjustment of observations, with the camera unless poses are held; None = no better."""
    held = any(isinstance(family, HeldPoses) for family in state.run.families.members)
    if held or not state.map.lenses:
        return patch_rounds.adjust_aligned(state, sighted, name, gates)
    solved, keypoints, found = camera.adjust_with_patches(state, sighted, name, gates)
    better = patch_rounds.carried(state, sighted, solved, keypoints)
    return None if better is None else better.with_cameras(found)


def _tied_within(state: State, parts: np.ndarray, merged: Registered | None = None) -> State:
    """The state whose prior is its own poses, without steps from one part (F,) to another."""
    poses = state.solution.world_T_rigs
    components = parts if merged is None else merged.components
    coarse = replace(state.prior.coarse, world_T_rigs=poses.copy())
    if merged is not None:
        coarse.world_T_rigs[:, :3, 3] -= merged.offsets
    trust = replace(StepChecks.of_all(poses), false_steps=parts[1:] != parts[:-1])
    apart = connectivity.several(np.asarray(components, np.int64))
    return replace(state, prior=Prior(coarse, trust, parts=apart, merged=merged))


def _with_unit(state: State, scales: np.ndarray, units: Sequence[int]) -> State:
    """Cameras in the unit of maps moved by scales (F,), each in that of a frame `units` (C,)."""
    if not state.map.lenses:
        return state
    factors = np.repeat(np.column_stack([np.ones(len(scales)), scales]), 3, axis=1)
    cameras = list[FoundCamera]()
    for one, frame in zip(state.map.cameras, units, strict=True):
        scaled, motion = one.scaled(float(scales[frame])), one.lenses.readout_motion
        if motion is not None:
            found = scaled.estimate()
            lenses = replace(found.lenses, readout_motion=motion * factors)
            scaled = scaled.with_estimate(replace(found, lenses=lenses))
        cameras.append(scaled)
    moved = replace(state.map, cameras=tuple(cameras))
    return replace(state, map=moved).through(moved.lenses)


def _check_unit(
    maps: JointMaps, merged: Registered, numbers: tuple[int, int], cameras: tuple[int, int]
) -> None:
    """Refuse two maps that meet in another scale than the lenses of a camera that both have."""
    lengths, shares = list[float](), list[float]()
    for number, c in zip(numbers, cameras, strict=True):
        run, move = maps.runs[number], maps.moves[number]
        centres = run.map.cameras[c].centres
        if centres is None or not centres.lenses:
            return
        length, sigma = baseline_of(centres, 1.0)
        scale = merged.scales[int(maps.main_rows(number)[0])]
        lengths.append(float(scale * move.scale * length))
        shares.append(sigma / length)
    off = abs(float(np.log(lengths[1] / lengths[0])))
    if off > max(_MAX_SCALE_SIGMAS * float(np.linalg.norm(shares)), np.log(_MAX_SCALE_RATIO)):
        first, run = (maps.runs[number] for number in numbers)
        raise ApartError(
            f"{run.root} contradicts the camera of {first.root}: where they meet, its lenses "
            f"are {np.exp(off):.2f} times as far apart, or the inverse; recordings of one layout, "
            "size and calibration must be of one camera, unless they name different models"
        )


def _settings_of_cameras(maps: JointMaps, start: CoarsePoses) -> tuple[RecordingEvidence, ...]:
    """Settings of the camera of each recording; () = there is one camera."""
    settings, frames = maps.cameras.settings, maps.frames
    if len(settings) == 1:
        return ()
    found = list[RecordingEvidence]()
    for name, rows in frames.recordings.items():
        own = CoarsePoses(start.world_T_rigs[rows], start.sources[rows], 0.0)
        camera = settings[frames.cameras[rows[0]]]
        found.append(RecordingEvidence(name, own, camera=camera, start=RunStart.EARLIER_RUN))
    return tuple(found)


def _by_features(state: State) -> Solution:
    """The map's points as seen by the features that lie where the map observes them."""
    from scipy.spatial import KDTree

    seen, shown = state.map.observed, state.observed.shown
    link = np.full(len(seen.faces), -1)  # feature of its frame at each observation
    for f in range(len(seen.starts) - 1):
        own = slice(int(seen.starts[f]), int(seen.starts[f + 1]))
        there = slice(int(shown.starts[f]), int(shown.starts[f + 1]))
        if own.start == own.stop or there.start == there.stop:
            continue
        gaps, near = KDTree(shown.bearings_rig[there]).query(seen.bearings_rig[own])
        gaps, near = np.asarray(gaps), np.asarray(near)
        allowed = np.minimum(SAME_PLACE_SIGMAS * shown.sigmas_rad[there][near], SAME_PLACE_RAD)
        order = np.argsort(gaps, kind="stable")
        _, first = np.unique(near[order], return_index=True)
        best = order[first]  # the nearest observation of each feature
        best = best[gaps[best] < allowed[best]]
        link[own.start + best] = near[best]
    solution = state.solution
    tracks, keypoints = solution.landmarks.tracks, link[seen.rows(solution.landmarks.tracks)]
    kept = keypoints >= 0
    found = Tracks(
        tracks.points[kept],
        tracks.frames[kept],
        keypoints[kept].astype(np.int32),
        tracks.num_points,
    )
    return replace(solution, landmarks=replace(solution.landmarks, tracks=found))


def _across(state: State, parts: np.ndarray, merged: Registered) -> State:
    """The state with matches of frames of different parts (F,), around the joined maps' points."""
    if not merged.met.any():
        return state
    near = state.with_solution(replace(_by_features(state), noise=1.0))
    found = frontend.match_across(near, parts)
    across = found.matches.across
    assert across is not None
    joined = np.unique(np.column_stack([merged.components, parts])[merged.met], axis=0)
    maps, numbers = np.unique(joined[:, 0], return_counts=True)
    met = set(joined[np.isin(joined[:, 0], maps[numbers > 1]), 1].tolist())
    if set(parts[across.pairs].ravel()) >= met:  # parts of maps that images joined from several
        return found
    return frontend.match_known_points_across(found, parts, "across_points")


def _crossing(state: State, parts: np.ndarray) -> Tracks:
    """Tracks of features that frames of two parts (F,) or more see."""
    tracks = backend.tracks_of(state)
    return tracks.of(_of_several(tracks, parts))


def _of_several(tracks: Tracks, parts: np.ndarray) -> np.ndarray:
    """Points (J,) bool that frames of different parts (F,) see."""
    chosen = np.zeros(tracks.num_points, bool)
    if len(tracks):
        owners, starts = parts[tracks.frames], np.flatnonzero(np.diff(tracks.points, prepend=-1))
        mixed = np.minimum.reduceat(owners, starts) != np.maximum.reduceat(owners, starts)
        chosen[tracks.points[starts]] = mixed
    return chosen


def _sighted(state: State) -> Sighted:
    map_ = state.map
    landmarks = map_.solution.landmarks
    seen = landmarks.tracks, landmarks.counts, map_.normals_rig
    return Sighted(map_.observed, map_.confirmed, *seen)


def _together(one: Sighted, other: Sighted) -> tuple[Sighted, np.ndarray]:
    """Observations of both, in each frame those of `one` first, counted as those of `other`, and
    the order of their keypoints among both (N,)."""
    first, second, tracks = one.keypoints, other.keypoints, other.tracks
    order = np.argsort(np.concatenate([first.frames(), second.frames()]), kind="stable")
    moved = tracks.keypoints + np.diff(first.starts)[tracks.frames]
    normals = list[np.ndarray]()
    for some in (one, other):
        unknown = np.zeros((len(some.aligned), 3), np.float32)
        normals.append(unknown if some.normals_rig is None else some.normals_rig)
    both = Sighted(
        joined_keypoints([first, second]).at(order, first.starts + second.starts),
        np.concatenate([one.aligned, other.aligned])[order],
        Tracks.joined([one.tracks, replace(tracks, keypoints=moved)]),
        other.counts,
        np.concatenate(normals)[order],
    )
    return both, order


def _without_same(base: Sighted, shared: Sighted, width: int) -> Sighted:
    """Observations without those of points that are observed anew among the shared ones."""
    from scipy.spatial import KDTree

    radius, tracks = 1.5 * 2 * np.pi / width, base.tracks  # a pixel and a half of a panorama
    near = np.zeros(len(base.aligned), bool)
    for f in range(len(base.keypoints.starts) - 1):
        there = shared.keypoints.bearings_of(f)
        own = slice(int(base.keypoints.starts[f]), int(base.keypoints.starts[f + 1]))
        if len(there) and own.start < own.stop:
            gaps, _ = KDTree(there).query(base.keypoints.bearings_rig[own])
            near[own] = np.asarray(gaps) < radius
    lengths = np.bincount(tracks.points, minlength=tracks.num_points)
    same = np.bincount(
        tracks.points, near[base.keypoints.rows(tracks)], minlength=tracks.num_points
    )
    left = same < 0.5 * np.maximum(lengths, 1)
    return replace(base, tracks=tracks.of(left))
