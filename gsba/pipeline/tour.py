"""Tours, stills metres apart without a trajectory: steps whose descriptors do not match, by patches
searched along epipolar lines (`gsba.odometry.tour_maps`)."""

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from functools import cache

import numpy as np

from gsba.camera.rig import CubeRig, owner_faces
from gsba.config import RefineSettings
from gsba.frames import cubemap
from gsba.log import GsbaError
from gsba.loop_closure import connectivity
from gsba.matching import recovery
from gsba.matching.recovery import Recovered
from gsba.odometry.tour_maps import TourMatches
from gsba.odometry.tour_order import MIN_FRAMES, Likeness, in_given_order, likeness, may_lack_order
from gsba.odometry.tour_steps import Step, TourFrame, read_stills
from gsba.odometry.tour_unordered import match_stills
from gsba.pipeline import frontend
from gsba.pipeline.run import Run
from gsba.pipeline.state import ObservedFrames, State
from gsba.significance import outweighs
from gsba.store.folder import STAGES
from gsba.store.store import PerFrame, RunStore, digest, fingerprint
from gsba.trajectory import judgement
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.steps import image_steps
from gsba.types import Features, FrameSet, Matches, rows_across
from gsba.version import __version__

logger = logging.getLogger(__name__)

_MAX_TIED_SHARE = 0.8  # of frames in maps of descriptors, below which places are searched
_MIN_INTERVAL_S = 1.5  # between stills metres apart; frames of a video can be had closer together
_MAX_ORDER_ERROR = 0.02  # probability that matches of stills in no order, if all match, show one
_NUM_FAR_PAIRS = 12  # compared with as many neighbours
_MIN_TIMED = 4  # stills whose order by given times is tested
_LIKENESS, _SEARCH, _STAGE = "likeness", "tour", "features_tour"
_STEPS = "tour_steps"  # folder of the finished steps of a search that is not finished
_FRAMES_IN_ORDER, _NUM_PLACES = 14, 3  # of frames one after another that tell an order from none;
# of these sequences, in one of which the camera may stand
_NO_ORDER = (
    "the order of the stills is not known: neighbours by name are hardly more alike than any two"
)
_IN_ORDER = "rename them in the order of the way, or, if they are in it, pass --timestamps or --fps"


class OrderFoundError(GsbaError):
    """Stills are in no order, and one was found: the run has to begin again in it."""


def check_order(state: State, found: Recovered) -> State:
    """The state, with a doubt where neighbours by given times are hardly more alike than any two,
    and with the steps that two frames alone show.

    Images alone make a wrong map of stills in no order where a place repeats. Frames whose matches
    show their order have one, and so have those of a video. Stills that `match_places` puts in
    order are left to it.

    Raises:
        GsbaError: such frames have no times.
    """
    run, frames = state.run, state.run.frames
    if not state.prior.absent or found.trust.turning_only:
        return state
    # Steps across which no other frame beside them matches may lead to a place that looks alike.
    nearest, further = _num_matches(found.neighbours.matches, len(frames))
    lone = 1 + np.flatnonzero((nearest[1:-1] > 0) & (further[:-1] == 0) & (further[1:] == 0))
    pairs = tuple(frames.names[f : f + 2] for f in lone.tolist())
    state = replace(state, prior=replace(state.prior, lone_steps=pairs))
    if (
        len(frames) < (_MIN_TIMED if frames.timed else MIN_FRAMES)
        or run.store.root.absolute() in frames.paths[0][0].parents
        or _may_be_in_no_order(run)
        or _show_order(state, found.neighbours.matches)
    ):
        return state
    num = min(len(frames), _FRAMES_IN_ORDER)
    begins = rows_across(len(frames) - num + 1, _NUM_PLACES)

    def in_order(first: int) -> bool:
        some = read_stills(frames.taken(np.arange(first, first + num)), run.num_threads)
        return in_given_order(likeness(some, run.num_threads))

    key = [_search_key(frames), frames.names]
    if run.store.stage(
        f"order{run.suffix}", key, lambda: any(map(in_order, begins.tolist())), bool
    ):
        return state
    if frames.timed:
        return replace(state, prior=replace(state.prior, order_doubted=True))
    alone = may_lack_order(len(frames)) and bool(run.suffix)
    remedy = "refine them alone, which puts them in order, and add them by gsba merge; or "
    raise GsbaError(f"{_NO_ORDER}; {remedy * alone}{_IN_ORDER}")


def match_places(state: State, found: Recovered) -> State | None:
    """The state before the map, its steps by searched places; None where descriptors tie most
    frames, or where places tie no more."""
    run, prior = state.run, state.prior
    tour = _search(state, found)
    if tour is None:  # of an earlier call, whose keypoints have other numbers
        run.store.forget_frames(_STAGE)
        return None
    observed, places = _with_places(state, tour)
    near = replace(tour.near, matches=places)
    steps = image_steps(near, observed.keypoints)
    given = tour.log_ratios, tour.log_sigmas, TwoViewLimits.of(run.settings), run.settings.priors
    trust = judgement.check_steps(prior.coarse, steps, *given)
    coarse = replace(prior.coarse, world_T_rigs=trust.world_T_rigs)
    prior = replace(prior, coarse=coarse, trust=trust, lone_steps=())  # three frames confirm steps
    return replace(state, observed=observed, places=places).begun(prior, near)


def _search(state: State, found: Recovered) -> TourMatches | None:
    """Steps of a tour by searched places; None where these are not needed, or tie no more."""
    run, num = state.run, len(state.run.frames)
    if (
        not state.prior.absent
        or found.trust.turning_only
        or not _may_be_tour(run.frames, run.settings)
    ):
        return None
    key, before, tied, alike = _search_key(run.frames), 0, False, None
    stills = cache(lambda: read_stills(run.frames, run.num_threads))  # for both stages
    known, steps = run.store.stored(_SEARCH, key, TourMatches), run.store.root / STAGES / _STEPS
    # In an order found by likeness, descriptors match what is only alike.
    if known is None or not known.order_found:
        before = _num_tied(found.neighbours.matches, num)
        tied = before > _MAX_TIED_SHARE * num
        known_order = not _may_be_in_no_order(run)
        if tied and (known_order or _show_order(state, found.neighbours.matches)):
            return None
        alike = None if known_order else _likeness_in_no_order(run, key, stills)
        if tied and alike is None:
            return None
    if known is None:
        logger.info(
            "descriptors tie %d of %d frames in maps of 3 and more%s: keypoints of neighbours are "
            "searched along epipolar lines, 8 s of processor time a step, 15 s a door "
            "(--set pairs.max_tour_frames=0 leaves it out)",
            before,
            num,
            ", but names are in no order" if tied else "",
        )

    def compute() -> TourMatches:
        return match_stills(stills(), run.frames.names, alike, run.num_threads, kept)

    def kept(names: tuple[str, str], compute: Callable[[], list[Step]]) -> list[Step]:
        name = digest(__version__, key, names)
        return list(
            PerFrame(steps, {name: name}, lambda _: tuple(compute()), tuple[Step, ...])[name]
        )

    tour = run.store.stage(_SEARCH, key, compute, TourMatches)
    shutil.rmtree(steps, ignore_errors=True)
    if tour.names != run.frames.names:
        raise OrderFoundError("the stills are in no order: refine them in the order found")
    if before and alike is not None:
        # neighbours by name match what is only alike
        raise GsbaError(f"{_NO_ORDER}, and images confirm no other order; {_IN_ORDER}")
    run.latest.append(_SEARCH)
    run.journal.note(_SEARCH, tour)
    return tour if _num_tied(tour.near.matches, num) > before else None


def _likeness_in_no_order(
    run: Run, key: object, stills: Callable[[], Sequence[TourFrame]]
) -> np.ndarray | None:
    """Likeness (F, F) of stills whose names are in no order; None = they are in order."""

    def compute() -> Likeness:
        return Likeness(likeness(stills(), run.num_threads))

    alike = run.store.stage(_LIKENESS, [key, run.frames.names], compute, Likeness).alike
    return None if in_given_order(alike) else alike


def _may_be_in_no_order(run: Run) -> bool:
    """True for stills whose order `match_places` looks for."""
    frames = run.frames
    possible = not (frames.timed or run.suffix) and may_lack_order(len(frames))
    return possible and _may_be_tour(frames, run.settings)


def in_known_order(store: RunStore, frames: FrameSet, settings: RefineSettings) -> FrameSet:
    """Stills in the order that a search has found, where one did; their times are the
    places in it."""
    if not _may_be_tour(frames, settings):
        return frames
    tour = store.stored(_SEARCH, _search_key(frames), TourMatches)
    if tour is None or tour.names == frames.names:
        return frames
    logger.info(
        "the stills are in no order: they are refined in the one found by their likeness, in which "
        "trajectory.tum has them; poses.csv names them"
    )
    rows = np.array([frames.names.index(name) for name in tour.names])
    return replace(frames.taken(rows), timestamps=np.arange(len(rows), dtype=float))


def _search_key(frames: FrameSet) -> object:
    """Pictures and masks that are searched, whatever their order is, unless times give it."""
    files = zip(frames.names, frames.paths, frames.mask_paths, strict=True)
    each = [(name, fingerprint(paths), fingerprint([mask])) for name, paths, mask in files]
    times = frames.timestamps.tolist() if frames.timed else []
    return sorted(each), times, [asdict(kind) for kind in frames.formats]


def _may_be_tour(frames: FrameSet, settings: RefineSettings) -> bool:
    """True for few frames that no video has taken."""
    if not 3 <= len(frames) <= settings.pairs.max_tour_frames:
        return False
    return not frames.timed or bool(np.median(np.diff(frames.timestamps)) >= _MIN_INTERVAL_S)


def _num_tied(matches: Matches, num: int) -> int:
    """Frames of `num` that matches tie to others, in maps of three frames and more."""
    return int(np.count_nonzero(connectivity.maps_of_images(matches.pairs, num) >= 0))


def _show_order(state: State, matches: Matches) -> bool:
    """True if all frames match the next one and the one after it, the next one with significantly
    more matches than that one or than frames far off, as those of a dense walk in order do. In a
    hall of bays, stills in no order may all match, too."""
    num = len(state.run.frames)
    nearest, further = _num_matches(matches, num)
    if not (nearest.all() and further.all()):
        return False
    return _significantly(nearest[:-1] + nearest[1:] - 2 * further) or _far_match_less(state, num)


def _far_match_less(state: State, num: int) -> bool:
    """True if neighbours have significantly more matches than frames a third to two thirds of `num`
    frames apart, without any prediction."""
    far = np.array(
        [(f, f + gap) for gap in range(num // 3, 2 * num // 3) for f in range(num - gap)]
    )
    far = far[rows_across(len(far), _NUM_FAR_PAIRS)]
    near = np.column_stack([far[:, 0], far[:, 0] + 1])
    chosen, rows = np.unique(np.concatenate([near, far]), axis=0, return_inverse=True)
    context = state.observed.context.by_search()  # of far pairs a network would take seconds each
    found = recovery.match_anywhere(context, chosen, rivals=False).matches
    counts = np.zeros((num, num), np.int64)
    counts[tuple(found.pairs.T)] = np.diff(found.offsets)
    of_pairs = counts[tuple(chosen.T)][rows.ravel()]
    return _significantly(of_pairs[: len(near)] - of_pairs[len(near) :])


def _significantly(differences: np.ndarray) -> bool:
    """True if significantly more differences (N,) are above than below zero."""
    wins, losses = (int(np.count_nonzero(sign * differences > 0)) for sign in (1, -1))
    return outweighs(wins, losses, _MAX_ORDER_ERROR)


def _num_matches(matches: Matches, num: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of matches of each of `num` frames with the next one (F - 1,), and with the one after
    it (F - 2,)."""
    counts = np.zeros((2, num), np.int64)
    gaps = matches.pairs[:, 1] - matches.pairs[:, 0]
    near = gaps <= 2
    counts[gaps[near] - 1, matches.pairs[near, 0]] = np.diff(matches.offsets)[near]
    return counts[0, : num - 1], counts[1, : num - 2]


def _with_places(state: State, tour: TourMatches) -> tuple[ObservedFrames, Matches]:
    """The frames with the rays of a tour as further keypoints, and its matches of these."""
    run, before = state.run, state.observed
    frames, rays = run.frames, np.split(tour.rays, tour.starts[1:-1])
    sigmas = np.split(tour.sigmas_rad, tour.starts[1:-1])
    index = {name: f for f, name in enumerate(frames.names)}

    def compute(name: str) -> Features:
        f = index[name]
        faces = cubemap.load(frames, f, run.rig)[0]
        return with_keypoints(before.features[f][name], rays[f], sigmas[f], faces, run.rig)

    inputs = dict.fromkeys(frames.names, 0)
    after = list(run.latest)
    found = run.store.per_frame(_STAGE, None, inputs, compute, Features, after, alone=True)
    each = [found] * len(frames)
    observed = replace(frontend.observe(run, "keypoints_tour", each, _STAGE), more=True)
    rows = list[np.ndarray]()
    shown = before.shown
    numbers = [
        rows_of_added(shown.faces[first:last], owner_faces(some))
        for first, last, some in zip(shown.starts[:-1], shown.starts[1:], rays, strict=True)
    ]
    matches = tour.near.matches
    for p, (f0, f1) in enumerate(matches.pairs):
        own = matches.of(p)
        rows.append(np.column_stack([numbers[f0][own[:, 0]], numbers[f1][own[:, 1]]]))
    return observed, Matches.of_rows(matches.pairs, [one.astype(np.int32) for one in rows])


def with_keypoints(
    found: Features, rays: np.ndarray, sigmas_rad: np.ndarray, faces: np.ndarray, rig: CubeRig
) -> Features:
    """Features of a frame and further keypoints without a descriptor, face after face, by their
    rays (N, 3), noise (N,) and the pictures (6, size, size, 3) of the faces."""
    owners = owner_faces(rays)
    pixels = rig.project(rays, owners)
    columns, lines = np.clip(pixels, 0, rig.size - 1).astype(int).T
    num = len(rays)
    added = Features(
        pixels,
        owners,
        rays,
        sigmas_rad,
        np.zeros((num, found.descriptors.shape[1]), found.descriptors.dtype),
        faces[owners, lines, columns],
        None if found.scores is None else np.zeros(num, np.float32),
    )
    order = np.argsort(np.append(found.faces, owners), kind="stable")
    columns = {
        entry.name: np.concatenate([getattr(found, entry.name), value])[order]
        for entry in fields(Features)
        if (value := getattr(added, entry.name)) is not None
    }
    return Features(**columns)


def rows_of_added(faces: np.ndarray, added: np.ndarray) -> np.ndarray:
    """Rows (N,) of keypoints on faces `added` (N,) behind others on their face (K,)."""
    order = np.argsort(np.append(faces, added), kind="stable")
    return np.argsort(order)[len(faces) :]
