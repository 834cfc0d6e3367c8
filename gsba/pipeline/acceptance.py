"""What a finished run must show before anything of it is written: else it is refused in a line."""

import numpy as np

from gsba.bundle.map_strength import step_deviations
from gsba.frames.masks import load_mask
from gsba.geometry import relative_steps, rotation_angle, step_covariances, typical_length, unit
from gsba.log import GsbaError
from gsba.masks.borders import find_borders
from gsba.masks.carrier import VEHICLE_SHARE
from gsba.types import FrameSet, Reconstruction

MIN_STEP_SIGMAS = 3.0  # median length of a map's steps, in standard deviations; maps of real and
# rendered walks have 40 and more; a camera that turns by less in a step, and moves by less, stands
_WALKED_SIGMAS = 20.0  # of a tenth of the steps, where somebody walks who stands in most of them
MAX_STEP_DEVIATION = 0.5  # of a step from the one that far frames predict, part of its length: true
# walks deviate by .006 at most, true positions of a turn by hand by .05
MIN_SHARE_AHEAD = 0.8  # of a vehicle's way: a tenth of it may go backwards


class NoPositions(GsbaError):
    """The images determine no positions; they may still show a turn on the spot."""


def refuse_vehicle_in_pieces(frames: FrameSet) -> None:
    """Refuse a way in pieces seen from a vehicle.

    Matches across a gap are then of what rides along or is far away, so that lengths on both sides
    of it do not agree.

    Args:
        frames: of a run whose odometry lost the camera on the way, with their masks.

    Raises:
        GsbaError: a vehicle carries the camera.
    """
    share = masked_scene_share(frames)
    if share >= VEHICLE_SHARE:
        raise GsbaError(
            f"{_riding_along(share)}, and the camera was lost on the way: how its parts lie to one "
            "another cannot be told; nothing is written: give a part that holds together (--set "
            "video.from_s=..., video.to_s=...), --masks of the vehicle, or a trajectory"
        )


def require_motion(frames: FrameSet, result: Reconstruction) -> None:
    """Refuse positions that images alone do not determine, and turns seen from a vehicle.

    A camera on a vehicle whose surroundings are blurred or far sees the vehicle stand still. Its
    turns look like those of a camera on a tripod, and its positions come from false matches: these
    are no better known than steps are long, or go to and fro.

    Args:
        frames: of the run, with their masks.

    Raises:
        NoPositions: the images determine no positions, and no vehicle is to blame.
        GsbaError: a vehicle is.
    """
    main = result.of_map(1)
    share = masked_scene_share(frames)
    where = _riding_along(share)
    if not len(main.points_world):
        if share < VEHICLE_SHARE:
            return
        raise GsbaError(
            f"nothing but turns can be told from these pictures: {where}, and what passes by "
            "shows no parallax: it is blurred or far away, or the vehicle stands; give more "
            "frames per second, --masks of the vehicle, or a trajectory"
        )
    sigmas, ahead = step_sigmas(main), share_ahead(main)
    if share >= VEHICLE_SHARE and ahead < MIN_SHARE_AHEAD:
        raise GsbaError(
            f"the images determine no positions: {where}, and {100 * ahead:.0f} % of the way that "
            f"was found go the same way as seen from there, where {100 * MIN_SHARE_AHEAD:.0f} % "
            "and more of a vehicle's do; nothing is written: give more frames per second, --masks "
            "of the vehicle, or a trajectory"
        )
    vehicle = share >= VEHICLE_SHARE
    walked = not vehicle and len(sigmas) and np.quantile(sigmas, 0.9) >= _WALKED_SIGMAS
    if walked or not len(sigmas) or np.median(sigmas) >= MIN_STEP_SIGMAS:
        deviations = step_deviations(main)  # from those that frames further away predict
        tested = deviations[np.isfinite(deviations)]
        wrong = np.count_nonzero(tested > MAX_STEP_DEVIATION)
        if wrong > 0.1 * len(tested):  # of steps
            raise NoPositions(
                f"the images determine no positions: {wrong} of {len(tested)} steps differ by more "
                f"than {100 * MAX_STEP_DEVIATION:.0f} % from those that frames further away "
                "predict: the camera hardly moves but turns; nothing is written: give frames of a "
                "walk, the camera's calibration, or a trajectory"
            )
        return
    cause = where if vehicle else "the camera hardly moves, or little matches"
    refusal = GsbaError if vehicle else NoPositions
    raise refusal(
        f"the images determine no positions: the median step is {np.median(sigmas):.1f} standard "
        f"deviations long, and {MIN_STEP_SIGMAS:g} are needed: {cause}; nothing is written: give "
        "sharper frames, other frames per second, or a trajectory"
    )


def step_sigmas(result: Reconstruction) -> np.ndarray:
    """Length of each step of a map over the standard deviation of its end, (N,) float64.

    Left out are steps of unknown covariance, and those in which the camera stands (a tripod, a
    frame given twice), unless it stands in all.
    """
    poses, joint = result.world_T_rigs, result.joint_errors
    if joint is None or len(poses) < 2:
        return np.zeros(0)
    steps = relative_steps(poses)
    spread = step_covariances(poses, result.pose_covariances, joint.neighbours)
    turn_variances, variances = (
        np.trace(spread[:, part, part], axis1=1, axis2=2) for part in (np.s_[:3], np.s_[3:])
    )
    known = np.isfinite(variances) & (variances > 0)
    lengths = np.linalg.norm(steps[known, :3, 3], axis=1) / np.sqrt(variances[known])
    turns = rotation_angle(steps[known, :3, :3])
    moves = (lengths > MIN_STEP_SIGMAS) | (turns > MIN_STEP_SIGMAS * np.sqrt(turn_variances[known]))
    return lengths[moves] if moves.any() else lengths


def share_ahead(result: Reconstruction) -> float:
    """Share of a map's way that adds up if each step is seen from the camera, at most 1.

    A vehicle goes where it faces. Steps from false matches go to and fro: of n of them, about one
    over the root of n adds up. No step counts for more than the typical one, as false ones are of
    any length. 1 for a map without steps.
    """
    steps = relative_steps(result.world_T_rigs)[:, :3, 3]
    lengths = np.linalg.norm(steps, axis=1)
    weights = np.minimum(lengths, typical_length(lengths))
    if not weights.sum() > 0:
        return 1.0
    return float(np.linalg.norm(weights @ unit(steps)) / weights.sum())


def masked_scene_share(frames: FrameSet) -> float:
    """Part of the sphere's panorama that the mask of the first frame leaves out, without areas that
    have no pixels in any frame."""
    mask = load_mask(frames, 0)
    if mask is None or (share := 1 - float(np.mean(mask))) < VEHICLE_SHARE:
        return 0.0 if mask is None else share
    return share - find_borders(frames).share


def _riding_along(share: float) -> str:
    """A clause that names a vehicle by its share of the picture."""
    return (
        f"{100 * share:.0f} % of the picture turn with the camera, as a vehicle does (see "
        "carrier_check.jpg)"
    )
