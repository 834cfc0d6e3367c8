"""Features followed from a keyframe's atlas into a frame's, by pyramidal Lucas-Kanade."""

import numpy as np

from gsba.odometry.atlas import Atlas, AtlasLayout, shared_faces
from gsba.odometry.lucas_kanade import LEVELS, WINDOW, align_patches

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
    margin = WINDOW / 2 + 1
    rows = np.flatnonzero(layout.inside(starts, faces, margin) & layout.inside(ends, faces, margin))
    found, bearings = np.zeros(len(predicted), bool), predicted.copy()
    if not len(rows):
        return bearings, found
    given = starts[rows], ends[rows]
    there, forth, difference = align_patches(template.pyramid, frame.pyramid, *given, LEVELS)
    expected = starts[rows] + there - ends[rows]  # as far off as the guess was
    back, home, _ = align_patches(frame.pyramid, template.pyramid, there, expected, 1)
    off = np.linalg.norm(back - starts[rows], axis=1)
    good = forth & home & (off < _MAX_RETURN_ERROR_PX) & (difference < _MAX_DIFFERENCE)
    good &= layout.inside(there, faces[rows], margin)
    rows, there = rows[good], there[good]
    found[rows] = True
    bearings[rows] = layout.bearings(there, faces[rows]) @ frame.cut_R_rig
    return bearings, found
