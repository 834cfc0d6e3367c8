#!/usr/bin/env bash
# OpenCV 5.0.0.93, ArUco: corners refined by CORNER_REFINE_APRILTAG lie .42 pixels to the lower right of
# those by the other methods. That one takes the corner of the first pixel as 0, 0, as the AprilTag
# library does, and all the rest of OpenCV its centre. A camera calibrated with such corners has its
# principal point there, and points of other detectors do not fit the tags.
# Expected of tags drawn with areas as pixels: corners half a pixel less than the drawn ones.
# Seen, means of 12 tags at any angle: -.50 without refinement, by SUBPIX and by CONTOUR, -.08 by APRILTAG.
# pupil-apriltags 1.0.4 is at 0: half a pixel has to be taken off its corners before cv2.solvePnP.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 pupil-apriltags==1.0.4.post11 \
  numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import cv2
import numpy as np
import pupil_apriltags

WIDTH, HEIGHT, FINE, CELL = 400, 300, 8, 16  # FINE samples a pixel, CELL pixels a cell of the tag
rng = np.random.default_rng(0)
family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
tag = np.pad(cv2.aruco.generateImageMarker(family, 7, 8), 1, constant_values=255)  # of 10 cells

def drawn():
    """Picture of a tag, seen askew, as means of areas, and its corners: the first pixel is 0 to 1."""
    angle, tilt = rng.uniform(-3, 3), rng.uniform(-1e-3, 1e-3, 2)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [*tilt, 1]])
    middle = np.array([WIDTH, HEIGHT]) / 2 + rng.uniform(size=2)
    placed = np.array([[1, 0, middle[0]], [0, 1, middle[1]], [0, 0, 1]]) @ turn
    placed = placed @ np.array([[CELL, 0, -5 * CELL], [0, CELL, -5 * CELL], [0, 0, 1]])  # of cells
    row, column = (np.mgrid[: HEIGHT * FINE, : WIDTH * FINE] + 0.5) / FINE
    cells = np.tensordot(np.linalg.inv(placed), [column, row, np.ones_like(row)], 1)
    cells = np.floor(cells[:2] / cells[2]).astype(int).clip(0, 9)  # beyond it is white
    fine = tag[cells[1], cells[0]].reshape(HEIGHT, FINE, WIDTH, FINE)
    corners = np.array([[1, 1, 1], [9, 1, 1], [9, 9, 1], [1, 9, 1]]) @ placed.T
    return fine.mean((1, 3)).round().astype(np.uint8), corners[:, :2] / corners[:, 2:]

def offset(found, corners):
    """Mean over the corners of what the nearest found one is beyond."""
    apart = found[None] - corners[:, None]
    nearest = np.linalg.norm(apart, axis=2).argmin(1)
    return apart[np.arange(4), nearest].mean(0)

others = pupil_apriltags.Detector(families="tag36h11", quad_decimate=1.0)
offsets = {}
for _ in range(12):
    picture, corners = drawn()
    for name in ("NONE", "SUBPIX", "CONTOUR", "APRILTAG"):
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{name}")
        found, (number,), _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(picture)
        assert number == 7
        offsets.setdefault(name, []).append(offset(found[0][0], corners))
    (found,) = others.detect(picture)
    offsets.setdefault("pupil-apriltags", []).append(offset(found.corners, corners))
for name, values in offsets.items():
    mean, spread = np.mean(values, 0), np.std(values, 0)
    print(f"{name}: corners beyond the drawn ones by {mean.round(2)} pixels, spread {spread.round(2)}")
    if name in ("APRILTAG", "pupil-apriltags"):
        assert abs(mean + (0.07 if name == "APRILTAG" else 0)).max() < 0.04, mean
    else:
        assert abs(mean + 0.5).max() < (0.1 if name == "NONE" else 0.03), mean
PROGRAM
