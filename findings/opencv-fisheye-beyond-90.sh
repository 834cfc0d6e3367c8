#!/usr/bin/env bash
# OpenCV 5.0.0.93, cv2.fisheye with lenses that see more than 180 degrees, as those of 360 cameras: a point
# past 90 degrees from the axis is projected to the other side of the picture, as its ray divided by z
# is that of the opposite point in front; a pixel past 90 degrees gets the tangent of 90 degrees, 1.6e16;
# and `solvePnP`, which rests on that, returns True with a pose somewhere else. The model itself, an angle
# times the focal length, has no such limit.
# Expected of an equidistant lens of 300 pixels: 95 degrees at column 997.4; and the pose of exact pairs of
# points and pixels. Seen: column 54.9; and of 30 poses of a lens of 190 degrees, where 8 % of the points
# are past 90, the best one is off by 5 m and half are off by more than 100 degrees and 1e12 m, while all
# of a lens of 178 degrees are exact.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 numpy==2.4.6 scipy==1.17.1
"$work/venv/bin/python" - <<'PROGRAM'
import cv2
import numpy as np
from scipy.spatial.transform import Rotation

FOCAL, MIDDLE = 300.0, 500.0
camera, plain = np.array([[FOCAL, 0, MIDDLE], [0, FOCAL, MIDDLE], [0, 0, 1]]), np.zeros(4)

for degrees in (80.0, 89.9, 90.1, 95.0, 100.0):
    angle = np.deg2rad(degrees)
    ray = np.array([[[np.sin(angle), 0, np.cos(angle)]]])
    column = cv2.fisheye.projectPoints(ray, np.zeros(3), np.zeros(3), camera, plain)[0][0, 0, 0]
    true = MIDDLE + FOCAL * angle
    tangent = cv2.fisheye.undistortPoints(np.array([[[true, MIDDLE]]]), camera, plain)[0, 0, 0]
    back = np.degrees(np.arctan(tangent))
    print(f"{degrees} degrees, column {true:.1f}: projected to {column:.1f}, undistorted to {back:.1f}")
    if degrees < 90:
        assert np.isclose(column, true) and np.isclose(back, degrees), (column, back)
    else:
        assert np.isclose(column, MIDDLE - FOCAL * (np.pi - angle)) and tangent > 1e15, (column, tangent)

def poses(field_of_view):
    """Errors in degrees and metres of 30 poses of 100 exact pairs each, and the share past 90 degrees."""
    rng, errors, past = np.random.default_rng(0), [], []
    for _ in range(30):
        angles = np.arccos(rng.uniform(np.cos(np.deg2rad(field_of_view / 2)), 1, 100))
        around = rng.uniform(0, 2 * np.pi, 100)
        aside = np.column_stack([np.cos(around), np.sin(around)])
        rays = np.column_stack([np.sin(angles)[:, None] * aside, np.cos(angles)])
        pixels = MIDDLE + FOCAL * angles[:, None] * aside
        turn, shift = Rotation.random(rng=rng), rng.normal(size=3)
        points = turn.inv().apply(rays * rng.uniform(2, 6, (100, 1)) - shift)
        good, vector, found = cv2.fisheye.solvePnP(points[:, None], pixels[:, None], camera, plain)
        assert good
        rotation = Rotation.from_rotvec(vector[:, 0])
        centre = rotation.inv().apply(found[:, 0]) - turn.inv().apply(shift)
        errors.append([np.degrees((rotation * turn.inv()).magnitude()), np.linalg.norm(centre)])
        past.append((angles > np.pi / 2).mean())
    return np.array(errors), np.mean(past)

for field_of_view in (178, 190):
    errors, past = poses(field_of_view)
    print(f"lens of {field_of_view} degrees, {past:.0%} of points past 90: poses off by (least, half, most)",
          *(f"{np.array2string(np.percentile(part, [0, 50, 100]), precision=1)} {unit}"
            for part, unit in zip(errors.T, ("degrees", "m"))))
    if field_of_view < 180:
        assert errors.max() < 1e-6, errors
    else:
        assert (errors[:, 1] > 1).mean() > 0.9 and np.median(errors[:, 0]) > 30, errors
PROGRAM
