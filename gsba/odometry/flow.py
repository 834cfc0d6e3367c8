"""Features followed from a keyframe's atlas into a frame's, by pyramidal Lucas-Kanade."""

import cv2
import numpy as np

from gsba.odometry.atlas import Atlas, AtlasLayout, shared_faces

_WINDOW = 15  # pixels across the patch that is followed
_LEVELS = 3  # halvings of the atlas
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02)  # iterations, pixels
_MIN_EIGENVALUE = 1e-4  # of a patch's gradients, as OpenCV normalises them
_MAX_RETURN_ERROR_PX = 0.6  # of a feature followed forth and back
_MAX_DIFFERENCE = 25.0  # grey values between both patches, in the mean


def follow(
    layout: AtlasLayout,
    template: Atlas,
    frame: Atlas,
    bearings_template: np.ndarray,
    predicted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Where features of one frame are in another.

    Each is followed on the face that shows both ends best, forth and back.

    Args:
        layout: of both atlases.
        template, frame: cut along nearly the same axes of the world.
        bearings_template: (N, 3) features in the template's rig frame.
        predicted: (N, 3) unit, where they are expected in the frame's rig frame.

    Returns:
        bearings (N, 3) in the frame's rig frame, and which of them (N,) bool were found.
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
    """Pixels (N, 2), whether found (N,), and the mean difference (N,) of both patches."""
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
