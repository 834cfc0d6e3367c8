"""Frames that show next to nothing, as behind a covered lens or in a damaged video.

Where images alone tell how the camera moved, such a frame would part the walk in two: it is left
out, and the frames beside it are neighbours. A trajectory gives it a pose, so that it stays.
"""

import logging
from dataclasses import asdict, dataclass

import numpy as np

from gsba.config import RefineSettings
from gsba.log import GsbaError
from gsba.pipeline.run import Evidence
from gsba.pipeline.state import State
from gsba.report.findings import named
from gsba.store.store import RunStore, fingerprint
from gsba.types import CoarsePoses, FrameSet

logger = logging.getLogger(__name__)

_STAGE = "blank"
_MIN_KEYPOINTS = 12  # of a frame: with fewer no pair of frames is verified
_MIN_FRAMES = 3  # that are left


@dataclass(frozen=True, slots=True)
class BlankFrames:
    """Result of the stage."""

    names: tuple[str, ...]


class BlankFramesError(GsbaError):
    """Some frames show next to nothing: the run has to begin again without them."""


def refuse(state: State) -> State:
    """The first state of a run. BlankFramesError: frames without a trajectory show nothing."""
    run, frames = state.run, state.run.frames
    few = np.diff(state.observed.keypoints.starts) < _MIN_KEYPOINTS
    few &= _without_trajectory(frames, run.coarse, run.evidence)
    blank = np.flatnonzero(few)
    if not len(blank) or len(frames) - len(blank) < _MIN_FRAMES:
        return state
    found = BlankFrames(tuple(frames.names[f] for f in blank))
    names = named(found.names, "frame_lists.blank", f"of {len(frames)} frames")
    logger.warning("frames that show next to nothing are left out: %s", names)
    run.store.stage(_STAGE, _key(frames, run.settings), lambda: found, BlankFrames)
    raise BlankFramesError("some frames show next to nothing")


def known(
    store: RunStore,
    frames: FrameSet,
    coarse: CoarsePoses,
    evidence: Evidence,
    settings: RefineSettings,
) -> tuple[str, ...]:
    """Names of the frames that a run on all these has found to show nothing."""
    if not _without_trajectory(frames, coarse, evidence).any():
        return ()
    found = store.stored(_STAGE, _key(frames, settings), BlankFrames)
    return () if found is None else found.names


def _without_trajectory(frames: FrameSet, coarse: CoarsePoses, evidence: Evidence) -> np.ndarray:
    """True (F,) for frames whose recording has no trajectory."""
    alone = np.full(len(frames), coarse.absent and not evidence.recordings)
    for one in evidence.recordings:
        alone[frames.recordings[one.name]] = one.coarse.absent
    return alone


def _key(frames: FrameSet, settings: RefineSettings) -> object:
    """All that keypoints rest on, whatever the frames' order is."""
    files = zip(frames.names, frames.paths, frames.mask_paths, strict=True)
    each = [(name, fingerprint(paths), fingerprint([mask])) for name, paths, mask in files]
    return sorted(each), [*map(asdict, frames.formats)], settings.features, settings.cubemap
