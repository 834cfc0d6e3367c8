"""Why a trajectory does not fit the images at all: reversed, mirrored, or of something else."""

import numpy as np

from gsba.config import VerifySettings
from gsba.geometry import inverse, rotation_angle
from gsba.log import GsbaError
from gsba.trajectory.steps import Steps
from gsba.types import CoarsePoses, PoseSource

_MIN_STEPS = 5  # fewer say nothing about a whole trajectory
_FITS = 0.5  # part of the steps that must roughly agree: of random ones, a third does
_LOOSE = {"max_rotation_deg": 20.0, "max_direction_deg": 60.0}  # roughly
_DOUBTFUL = 0.6  # part below which another reading that explains the rest is the right one
_EXPLAINS = 0.7  # part of the steps that a reading must explain to be named
_WITHOUT = "or refine without it (--no-trajectory)"


def refuse_useless(coarse: CoarsePoses) -> None:
    """Refuse poses that say nothing.

    Raises:
        GsbaError: all poses are one and the same.
    """
    poses = coarse.world_T_rigs
    if len(poses) > 1 and np.abs(poses - poses[0]).max() < 1e-12:
        raise GsbaError(
            f"all {len(poses)} poses of the trajectory are identical: check the file, {_WITHOUT}"
        )


def refuse_misread(coarse: CoarsePoses, found: Steps, settings: VerifySettings) -> None:
    """Refuse a trajectory that most steps of the images contradict, but not if read otherwise.

    Args:
        coarse: the trajectory.
        found: steps from the images.
        settings: disagreement that counts as contradiction.

    Raises:
        GsbaError: it is reversed, mirrored, inverted or in other axes.
    """
    judged = _judged(coarse, found)
    if judged.sum() < _MIN_STEPS:
        return
    shares = {
        reading: _agreeing(steps, found, judged, settings)
        for reading, steps in _readings(coarse.world_T_rigs).items()
    }
    best = max(shares, key=lambda reading: shares[reading])
    if not best or shares[best] < _EXPLAINS or shares[""] >= _DOUBTFUL:
        return
    late, explained = _lateness(coarse, found, judged, settings)
    if explained >= shares[best] * judged.sum():
        return  # on a loop, the other side looks reversed
    text, other = _contradicted(shares[""], judged), ""
    if late:
        other = f" or on another clock, by about {abs(late)} frames"
    raise GsbaError(f"{text}: the trajectory is {best}{other}, {_WITHOUT}")


def refuse_misfit(coarse: CoarsePoses, found: Steps, settings: VerifySettings) -> None:
    """Refuse a trajectory that most steps of the images contradict, with the likely reason.

    Args:
        coarse, found, settings: as for `refuse_misread`.

    Raises:
        GsbaError: most steps disagree.
    """
    refuse_misread(coarse, found, settings)
    judged, loose = _judged(coarse, found), settings.model_copy(update=_LOOSE)
    steps = _steps(coarse.world_T_rigs)
    if judged.sum() < _MIN_STEPS or _agreeing(steps, found, judged, loose) > _FITS:
        return
    text = _contradicted(_agreeing(steps, found, judged, settings), judged)
    late, _ = _lateness(coarse, found, judged, settings)
    if late:
        raise GsbaError(
            f"{text}: the trajectory is on another clock, by about {abs(late)} frames: correct "
            f"the times or read.clock_offset_s, {_WITHOUT}"
        )
    raise GsbaError(
        f"{text}: the trajectory is of another recording or on another clock; "
        f"give the right one, {_WITHOUT}"
    )


def _lateness(
    coarse: CoarsePoses, found: Steps, judged: np.ndarray, settings: VerifySettings
) -> tuple[int, float]:
    """By how many frames the trajectory's steps are late, and how many steps that explains.

    0 where no shift in time explains what a reading has to.
    """
    steps, best = _steps(coarse.world_T_rigs), (0, 0.0)
    own = coarse.sources[:-1] == PoseSource.SLAM
    own &= coarse.sources[1:] == PoseSource.SLAM
    for late in range(1 - len(steps), len(steps)):
        theirs = slice(max(late, 0), len(steps) + min(late, 0))
        ours = slice(max(-late, 0), len(steps) - max(late, 0))
        seen = Steps(found.f_T_nexts[ours], found.verified[ours], found.directed[ours])
        both = seen.directed & own[theirs]
        if late == 0 or both.sum() < max(_MIN_STEPS, 0.5 * judged.sum()):
            continue
        share = _agreeing(steps[theirs], seen, both, settings)
        if share >= _EXPLAINS and share * both.sum() > best[1]:
            best = late, share * float(both.sum())
    return best


def _judged(coarse: CoarsePoses, found: Steps) -> np.ndarray:
    """Steps (F - 1,) bool between SLAM poses, in a direction that the images tell."""
    own = coarse.sources == PoseSource.SLAM
    return found.directed & own[:-1] & own[1:]


def _contradicted(share: float, judged: np.ndarray) -> str:
    total = int(judged.sum())
    return f"the images contradict {round((1 - share) * total)} of {total} steps"


def _steps(poses: np.ndarray) -> np.ndarray:
    """Relative poses (F - 1, 4, 4) of consecutive ones."""
    return inverse(poses[:-1]) @ poses[1:]


def _readings(world_T_rigs: np.ndarray) -> dict[str, np.ndarray]:
    """What a trajectory's steps (F - 1, 4, 4) would be if it had been written otherwise."""
    steps = _steps(world_T_rigs)
    readings = {
        "": steps,
        "reversed in time: check its timestamps": _steps(world_T_rigs[::-1]),
        "camera-from-world: invert its poses": _steps(inverse(world_T_rigs)),
        "in axes of y up and z backward: convert it to y down and z forward": _flipped(
            steps, [1, -1, -1]
        ),
        "turned by half about the vertical axis: its x and z point the other way": _flipped(
            steps, [-1, 1, -1]
        ),
    }
    for name, axis in zip("xyz", np.eye(3), strict=True):
        mirrored = f"mirrored along {name}: it is no rigid motion of this camera, flip that axis"
        readings[mirrored] = _flipped(steps, 1 - 2 * axis)
    return readings


def _flipped(steps: np.ndarray, signs: np.ndarray | list[int]) -> np.ndarray:
    flip = np.diag([*signs, 1.0])
    return flip @ steps @ flip


def _agreeing(
    steps: np.ndarray, found: Steps, judged: np.ndarray, settings: VerifySettings
) -> float:
    """Part of the judged steps that the images do not contradict."""
    between = np.swapaxes(steps[:, :3, :3], 1, 2) @ found.f_T_nexts[:, :3, :3]
    moved, seen = steps[:, :3, 3], found.f_T_nexts[:, :3, 3]
    across = np.linalg.norm(np.cross(moved, seen), axis=1)
    off = np.arctan2(across, np.einsum("fi,fi->f", moved, seen))
    agree = rotation_angle(between) < np.deg2rad(settings.max_rotation_deg)
    agree &= off < np.deg2rad(settings.max_direction_deg)
    return float(agree[judged].mean())
