"""Maps that will be weak, as a few pairs of neighbours foretell before all frames are searched.

A walk that does not come back has no loops that hold it: its drift grows with its length, and falls
with the matches of its steps. Where it will be weak, its frames get as many keypoints as weak ones
at once, instead of few first and more later.
"""

from collections.abc import Mapping

import numpy as np

from factors.threads import map_in_threads
from gsba.features.detection import search_settings
from gsba.features.extraction import Search
from gsba.geometry import inverse
from gsba.matching import guided_search
from gsba.matching.guided_search import PRIOR_GATE, SearchableFrames
from gsba.matching.verification import relative_pose
from gsba.pipeline.run import Run
from gsba.trajectory.returning import comes_back
from gsba.types import Features

_NUM_STEPS = 3  # compared, spread over the walk
_DRIFT_PER_FRAME = 0.13  # times frames over squared matches of a step: the drift of rendered walks
# of 24 to 48 frames is 0.10 to 0.15 times it; a real one of 11 frames drifts eight times as much


def expected_drift(run: Run, search: Search) -> tuple[float, dict[str, Features]]:
    """Drift to be expected of a run whose frames were not searched yet, part of its path.

    Args:
        run: the run.
        search: of its frames.

    Returns:
        The drift, 0 where nothing foretells it; and keypoints of the frames that were compared, by
        name: none if an earlier call did.
    """
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
    drift = run.store.stage("expected_drift", key, compute, float, run.chain.latest)
    return drift, found


def _matches(run: Run, found: Mapping[str, Features], steps: np.ndarray) -> float:
    """Median number of verified matches of steps (S, 2) between frames, by strong keypoints."""

    def load(frame: int) -> Features:
        return found[run.frames.names[frame]]

    settings, poses = run.matching_settings, run.coarse.world_T_rigs
    chance = PRIOR_GATE.chance(np.deg2rad(settings.verify.max_error_deg))
    frames = SearchableFrames(load, settings.pairs.strongest_per_face)

    def verified(step: int) -> int:
        f0, f1 = steps[step].tolist()
        f0_T_f1 = inverse(poses[f0]) @ poses[f1]
        rows = guided_search.guided(
            frames, (f0, f1), f0_T_f1, PRIOR_GATE, search_settings(settings)
        )
        rays = load(f0).bearings_rig[rows[:, 0]], load(f1).bearings_rig[rows[:, 1]]
        pose = relative_pose(*rays, settings.verify, settings.seed, chance)
        return 0 if pose is None else int(np.count_nonzero(pose.inliers))

    return float(np.median(list(map_in_threads(verified, len(steps), run.num_threads))))
