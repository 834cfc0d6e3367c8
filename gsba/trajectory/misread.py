"""Detection of trajectories in another convention, or of another recording."""

from dataclasses import replace

import numpy as np

from gsba.geometry import inverse, pose, relative_steps
from gsba.log import GsbaError
from gsba.trajectory.conventions import CAMERA_FROM_WORLD, OURS, WXYZ, axis_systems, w_first
from gsba.trajectory.limits import TwoViewLimits
from gsba.trajectory.steps import Steps, step_errors, tracked_steps
from gsba.types import CoarsePoses

_MIN_STEPS = 5  # least number of steps that judge a whole trajectory
_MIN_EXPLAINED_SHARE = 0.7  # least share of steps that another convention must explain
_COMMON_SYSTEMS = "right-up-back", "left-down-back", "left-up-forward"  # half turns: of graphics,
# about the vertical axis, about the forward axis
ADVICE = "or refine without it (--no-trajectory)"


class TurnedAboutForwardError(GsbaError):
    """A trajectory in axes that differ from the camera's by a turn about the forward one, as those
    of upright panoramas do from raw pictures of a sensor that is mounted on its side."""

    def __init__(self, message: str, ours_R_theirs: np.ndarray) -> None:
        super().__init__(message)
        self.ours_R_theirs = ours_R_theirs  # (3, 3) float64


def refuse_useless(coarse: CoarsePoses) -> None:
    """Refuse a trajectory without information: all poses are identical."""
    poses = coarse.world_T_rigs
    if len(poses) > 1 and np.abs(poses - poses[0]).max() < 1e-12:
        raise GsbaError(
            f"all {len(poses)} poses of the trajectory are identical: check the file, {ADVICE}"
        )


def refuse_misread(coarse: CoarsePoses, found: Steps, settings: TwoViewLimits) -> None:
    """Refuse a trajectory that most steps of the images contradict, but not in another convention;
    TurnedAboutForwardError if its axes are turned about the forward one."""
    judged = found.directed & tracked_steps(coarse)
    if judged.sum() < _MIN_STEPS:
        return
    readings = _steps_in_other_conventions(coarse.world_T_rigs)
    shares = {
        reading: _agreeing_share(steps, found, judged, settings)
        for reading, steps in readings.items()
    }
    most = max(shares.values())
    likely = [
        reading for reading in shares if shares[reading] * judged.sum() > most * judged.sum() - 1
    ]

    def mean_error(reading: str) -> float:
        """Radians per judged step: tells readings apart that differ in small motions."""
        turned, off = step_errors(readings[reading], found)
        return float(np.mean((turned + off)[judged]))

    best = min(likely, key=mean_error)
    if not best or shares[best] < _MIN_EXPLAINED_SHARE or shares[""] >= 0.6:
        return
    late, explained = _delay_in_frames(coarse, found, judged, settings)
    if explained >= shares[best] * judged.sum():
        return  # on a loop, the way back looks reversed
    text, other = _contradiction_text(shares[""], judged), ""
    if late:
        other = f"; or it is on another clock, by about {abs(late)} frames"
    message = f"{text}: the trajectory is {best}{other}, {ADVICE}"
    for name, ours_R_theirs in axis_systems():
        if best == _in_system(name) and name.endswith("forward"):
            raise TurnedAboutForwardError(message, ours_R_theirs)
    raise GsbaError(message)


def refuse_misfit(coarse: CoarsePoses, found: Steps, settings: TwoViewLimits) -> None:
    """Refuse a trajectory that most steps of the images contradict, with the likely reason."""
    refuse_misread(coarse, found, settings)
    judged = found.directed & tracked_steps(coarse)
    loose = replace(settings, max_rotation_deg=20.0, max_direction_deg=60.0)
    steps = relative_steps(coarse.world_T_rigs)
    # of random steps, a third agrees
    if judged.sum() < _MIN_STEPS or _agreeing_share(steps, found, judged, loose) > 0.5:
        return
    text = _contradiction_text(_agreeing_share(steps, found, judged, settings), judged)
    late, _ = _delay_in_frames(coarse, found, judged, settings)
    if late:
        raise GsbaError(
            f"{text}: the trajectory is on another clock, by about {abs(late)} frames: correct "
            f"the times or read.clock_offset_s, {ADVICE}"
        )
    raise GsbaError(
        f"{text}: the trajectory is of another recording or on another clock; "
        f"give the right one, {ADVICE}"
    )


def _delay_in_frames(
    coarse: CoarsePoses, found: Steps, judged: np.ndarray, settings: TwoViewLimits
) -> tuple[int, float]:
    """Delay of the trajectory in frames, 0 if none explains enough, and the share explained."""
    steps, best = relative_steps(coarse.world_T_rigs), (0, 0.0)
    own = tracked_steps(coarse)
    for late in range(1 - len(steps), len(steps)):
        theirs = slice(max(late, 0), len(steps) + min(late, 0))
        ours = slice(max(-late, 0), len(steps) - max(late, 0))
        seen = Steps(found.f_T_nexts[ours], found.verified[ours], found.direction_sigmas[ours])
        both = seen.directed & own[theirs]
        if late == 0 or both.sum() < max(_MIN_STEPS, 0.5 * judged.sum()):
            continue
        share = _agreeing_share(steps[theirs], seen, both, settings)
        if share >= _MIN_EXPLAINED_SHARE and share * both.sum() > best[1]:
            best = late, share * float(both.sum())
    return best


def _contradiction_text(share: float, judged: np.ndarray) -> str:
    total = int(judged.sum())
    return f"the images contradict {round((1 - share) * total)} of {total} steps"


def _steps_in_other_conventions(world_T_rigs: np.ndarray) -> dict[str, np.ndarray]:
    """Steps (F - 1,) of a trajectory in other conventions, the commoner ones first."""
    steps = relative_steps(world_T_rigs)
    reordered = relative_steps(pose(w_first(world_T_rigs[:, :3, :3]), world_T_rigs[:, :3, 3]))
    readings = {
        "": steps,
        "reversed in time: check its timestamps": relative_steps(world_T_rigs[::-1]),
        f"{CAMERA_FROM_WORLD}: {_pass(CAMERA_FROM_WORLD)}": relative_steps(inverse(world_T_rigs)),
    }
    systems = {name: rotation for name, rotation in axis_systems() if name != OURS}
    for name in sorted(systems, key=lambda name: name not in _COMMON_SYSTEMS):
        readings[_in_system(name)] = _in_axes(steps, systems[name])
    for name, axis in zip("xyz", np.eye(3), strict=True):
        mirrored = f"mirrored along {name}: it is no rigid motion of this camera, flip that axis"
        flip = np.diag([*(1 - 2 * axis), 1.0])
        readings[mirrored] = flip @ steps @ flip
    order = "in quaternions of the order w, x, y, z"
    readings[f"{order}: {_pass(WXYZ)}"] = reordered
    for name, rotation in systems.items():
        both = f"{order}, and {_axes(name)}: {_pass(f'{WXYZ},{name}')}"
        readings[both] = _in_axes(reordered, rotation)
    return readings


def _pass(words: str) -> str:
    return f"pass --trajectory-format {words}"


def _in_system(system: str) -> str:
    return f"{_axes(system)}: {_pass(system)}"


def _axes(system: str) -> str:
    return "in axes of " + ", ".join(map(" ".join, zip("xyz", system.split("-"), strict=True)))


def _in_axes(steps: np.ndarray, ours_R_theirs: np.ndarray) -> np.ndarray:
    """Steps (F - 1, 4, 4) of a camera in our axes, from those in other axes."""
    turn = np.eye(4)
    turn[:3, :3] = ours_R_theirs
    return turn @ steps @ turn.T


def _agreeing_share(
    steps: np.ndarray, found: Steps, judged: np.ndarray, settings: TwoViewLimits
) -> float:
    turned, off = step_errors(steps, found)
    agree = turned < np.deg2rad(settings.max_rotation_deg)
    agree &= off < np.deg2rad(settings.max_direction_deg)
    return float(agree[judged].mean())
