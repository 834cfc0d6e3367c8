"""Features followed from a keyframe's atlas into a frame's, by pyramidal Lucas-Kanade."""

import cv2
import numpy as np

from gsba.odometry.atlas import Atlas, AtlasLayout, shared_faces

_WINDOW = 15  # pixels across the patch that is followed
_LEVELS = 3  # halvings of the atlas
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)  # iterations, pixels
_MIN_EIGENVALUE = 1e-4  # least eigenvalue of a patch's gradients, in OpenCV's normalisation
_MAX_RETURN_ERROR_PX = 0.6  # largest error of a feature followed forth and back
_MAX_DIFFERENCE = 25.0  # largest mean difference of both patches, grey values


def follow(
    layout: AtlasLayout,
    template: Atlas,
    frame: Atlas,
    bearings_template: np.ndarray,
    predicted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Bearings of one frame's features in another frame.

    Each is followed, forth and back, on the face that best shows both bearings.

    Args:
        layout: of both atlases.
        template, frame: cut along nearly the same axes of the world.
        bearings_template: (N, 3) features in the template's rig frame.
        predicted: (N, 3) unit, predicted bearings in the frame's rig frame.

    Returns:
        bearings (N, 3) in the frame's rig frame, and (N,) bool, True for found features.
    """
    before = bearings_template @ template.cut_R_rig.T
    guess = predicted @ frame.cut_R_rig.T
    faces = shared_faces(before, guess)
    starts, ends = layout.pixels(before, faces), layout.pixels(guess, faces)
    margin = _WINDOW / 2
    rows = np.flatnonzero(layout.inside(starts, faces, margin) & layout.inside(ends, faces, margin))
    found, bearings = np.zeros(len(predicted), bool), predicted.copy()
    if not len(rows):
        return bearings, found
    there, forth, difference = _flow(template.image, frame.image, starts[rows], ends[rows], _LEVELS)
    back, home, _ = _flow(frame.image, template.image, there, starts[rows] + there - ends[rows], 1)
    off = np.linalg.norm(back - starts[rows], axis=1)
    good = forth & home & (off < _MAX_RETURN_ERROR_PX) & (difference < _MAX_DIFFERENCE)
    good &= layout.inside(there, faces[rows], margin)
    rows, there = rows[good], there[good]
    found[rows] = True
    bearings[rows] = layout.bearings(there, faces[rows]) @ frame.cut_R_rig
    return bearings, found


def _flow(
    one: np.ndarray, other: np.ndarray, starts: np.ndarray, guess: np.ndarray, levels: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2), True (N,) if found, and the mean difference (N,) of both patches."""
    ends, status, difference = cv2.calcOpticalFlowPyrLK(
        one,
        other,
        np.ascontiguousarray(starts, np.float32).reshape(-1, 1, 2),
        np.ascontiguousarray(guess, np.float32).reshape(-1, 1, 2),
        winSize=(_WINDOW, _WINDOW),
        maxLevel=levels,
        criteria=_STEPS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
    )
    return ends[:, 0].astype(np.float64), status[:, 0] > 0, difference[:, 0]
