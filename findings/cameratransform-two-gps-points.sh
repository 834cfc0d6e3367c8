#!/usr/bin/env bash
# cameratransform 1.2.1, `Camera.spaceFromGPS` and all that stands on it, such as `Camera.imageFromGPS`, which projects
# surveyed landmarks into a picture: of exactly two points (2, 3) the heights are taken for 0.
# Expected: each point's own height, as for one point, three and more. Seen: two landmarks 40 and 60 m above the
# camera's zero level, 100 m away, are drawn 320 and 480 pixels too low, without a word.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet cameratransform==1.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import cameratransform as ct
import numpy as np

FOCAL, WIDTH, HEIGHT, EYE = 800.0, 1600, 1200, 10.0  # pixels; metres above zero
camera = ct.Camera(
    ct.RectilinearProjection(focallength_px=FOCAL, image=(WIDTH, HEIGHT)),
    ct.SpatialOrientation(elevation_m=EYE, tilt_deg=90),  # level, to the north
)
camera.setGPSpos(48.0, 11.0, EYE)
place = np.array([[10.0, 100, 40], [-20, 100, 60], [30, 100, 20]])  # east, north, up, metres
landmarks = camera.gpsFromSpace(place)
right = np.column_stack(
    [WIDTH / 2 + FOCAL * place[:, 0] / place[:, 1], HEIGHT / 2 - FOCAL * (place[:, 2] - EYE) / place[:, 1]]
)

one_by_one = np.array([camera.imageFromGPS(point) for point in landmarks])
three, two = camera.imageFromGPS(landmarks), camera.imageFromGPS(landmarks[:2])
heights = camera.spaceFromGPS(landmarks[:2])[:, 2]
print(f"by hand {right.round(1).tolist()}\none by one {one_by_one.round(1).tolist()}")
print(f"three at once {three.round(1).tolist()}\ntwo at once {two.round(1).tolist()}, heights {heights}")
assert np.allclose(one_by_one, right, atol=0.5) and np.allclose(three, right, atol=0.5)
assert (heights == 0).all()
low = two[:, 1] - right[:2, 1]
print(f"two at once are {low.round(0)} pixels too low")
assert np.allclose(low, FOCAL * place[:2, 2] / place[:2, 1], atol=1), low
PROGRAM
