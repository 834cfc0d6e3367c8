"""Frames that cannot be matched, as behind a covered lens, blurred, or of a damaged video.

Where images alone tell how the camera moved, such a frame would part the walk in two: it is left
out, and the frames beside it are neighbours. If a trajectory has a pose for it, it stays.
"""

import logging
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import numpy as np

from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.matching import recovery
from gsba.matching.recovery import Recovered
from gsba.pipeline.run import Evidence
from gsba.pipeline.state import State
from gsba.report.findings import named
from gsba.store.store import RunStore, fingerprint
from gsba.types import CoarsePoses, FrameSet, PoseSource, RunStart

logger = logging.getLogger(__name__)

_BLANK, _ODD = "blank_frames", "odd_frames"  # stages
_MIN_KEYPOINTS = 12  # of a frame: with fewer no pair of frames is verified
_MIN_FRAMES = 3  # that are left
_MOST_IN_A_ROW = 3  # frames without matches: further apart, others hardly match


@dataclass(frozen=True, slots=True)
class UnusableFrames:
    """Result of either stage."""

    names: tuple[str, ...]


class UnusableFramesError(GsbaError):
    """Some frames cannot be matched: the run has to begin again without them."""


def refuse_blank(state: State) -> State:
    """The first state of a run. UnusableFramesError: frames that no trajectory has show next to
    nothing."""
    run, frames = state.run, state.run.frames
    few = np.diff(state.observed.keypoints.starts) < _MIN_KEYPOINTS
    few &= _without_pose(frames, run.coarse, run.evidence)
    for rows in frames.recordings.values() or (slice(None),):
        few[rows] &= np.count_nonzero(~few[rows]) >= _MIN_FRAMES
    if few.any():
        _refuse(state, _BLANK, "show next to nothing", lambda: np.flatnonzero(few))
    return state


def refuse_odd(state: State, found: Recovered) -> None:
    """UnusableFramesError: without a trajectory, up to three frames in a row match neither of the
    frames beside them, though these match one another; asked once."""
    unseen = found.trust.unseen_steps
    beside = [  # of the shortest rows first
        (before, after)
        for length in range(1, _MOST_IN_A_ROW + 1)
        for before in range(len(unseen) - length)
        if unseen[before : (after := before + length + 1)].all()
        and not (unseen[before - 1 : before].all() and unseen[after : after + 1].all())
    ]
    asked = not found.trust.turning_only and state.prior.absent and not state.run.evidence.odd
    if not asked or not beside:
        return

    def compute() -> list[int]:
        over = np.array(beside, np.int32)
        matched = recovery.match_anywhere(state.observed.context, over).frames()
        odd = set[int]()
        for before, after in beside:
            if (before, after) in matched and odd.isdisjoint(range(before, after + 1)):
                odd |= {*range(before + 1, after)}
        return sorted(odd)

    _refuse(
        state, _ODD, "match neither of the frames beside them, which match one another", compute
    )


def _refuse(state: State, stage: str, what: str, compute: Callable[[], Iterable[int]]) -> None:
    """UnusableFramesError: a stage finds such frames, which the next attempt knows of."""
    store, frames = state.run.store, state.run.frames

    def find() -> UnusableFrames:
        return UnusableFrames(tuple(frames.names[f] for f in compute()))

    key = _key(frames, state.run.settings)
    if names := store.stage(stage, key, find, UnusableFrames).names:
        few = named(names, "frame_lists.unusable", f"of {len(frames)} frames")
        logger.warning("frames that %s are left out: %s", what, few)
        raise UnusableFramesError(f"leave out frames that {what}: {few}")


def known(
    store: RunStore,
    frames: FrameSet,
    coarse: CoarsePoses,
    evidence: Evidence,
    settings: RefineSettings,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the frames that earlier attempts on all these have found blank, and odd."""
    if not _without_pose(frames, coarse, evidence).any():
        return (), ()

    def names(stage: str, some: FrameSet) -> tuple[str, ...]:
        found = store.stored(stage, _key(some, settings), UnusableFrames)
        return () if found is None else found.names

    blank = names(_BLANK, frames)
    left = np.flatnonzero([name not in blank for name in frames.names])
    return blank, names(_ODD, frames.taken(left))


def _without_pose(frames: FrameSet, coarse: CoarsePoses, evidence: Evidence) -> np.ndarray:
    """True (F,) for frames that no trajectory has; none of those that odometry has followed."""
    alone = np.zeros(len(frames), bool)
    of_each = [
        (frames.recordings[one.name], one.coarse, one.start) for one in evidence.recordings
    ] or [(np.arange(len(frames)), coarse, evidence.start)]
    for rows, own, start in of_each:
        alone[rows] = own.absent | ((own.sources != PoseSource.SLAM) & (start != RunStart.ODOMETRY))
    return alone


def _key(frames: FrameSet, settings: RefineSettings) -> object:
    """All that keypoints and their matches rest on, whatever the order of stills is."""
    files = zip(frames.names, frames.paths, frames.mask_paths, strict=True)
    each = [(name, fingerprint(paths), fingerprint([mask])) for name, paths, mask in files]
    kinds, times = [*map(asdict, frames.formats)], frames.timestamps.tolist() * frames.timed
    how = settings.features, settings.cubemap, settings.matching, settings.pairs, settings.seed
    return sorted(each), kinds, times, how, settings.gate_factor
