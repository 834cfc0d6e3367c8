#!/usr/bin/env bash
# COLMAP 4.2 (pycolmap 4.2.1), fisheye cameras that see more than 180 degrees: the ray of a pixel
# that lies past 90 degrees from the axis is another one, up to 33 degrees away, without a word.
# Expected of cam_ray_from_img, whose rays are unit vectors and could point backwards: 90.1, 95 and
# 100 degrees where the equidistant model has these. Seen: 57.5, 58.9 and 60.2 degrees (the angle
# whose tangent is the pixel's radius over the focal length), after 89.9 as it should be; and None
# from img_from_cam for the ray at 95 degrees itself.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet pycolmap==4.2.1 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import pycolmap

FOCAL = 300.0
models = {"SIMPLE_FISHEYE": [], "OPENCV_FISHEYE": [0.0] * 4, "RADIAL_FISHEYE": [0.0] * 2}
for model, coefficients in models.items():
    focal = [FOCAL, FOCAL] if model.startswith("OPENCV") else [FOCAL]
    camera = pycolmap.Camera(
        model=model, width=1000, height=1000, params=[*focal, 500.0, 500.0, *coefficients]
    )
    seen = []
    for degrees in (60.0, 89.9, 90.1, 95.0, 100.0):
        pixel = np.array([[500.0 + FOCAL * np.deg2rad(degrees), 500.0]])
        x, _, z = camera.cam_ray_from_img(pixel)[0]
        seen.append(np.degrees(np.arctan2(x, z)))
    print(model, "angles of rays at 60, 89.9, 90.1, 95 and 100 degrees:", np.round(seen, 1))
    assert np.allclose(seen[:2], [60.0, 89.9], atol=0.01), seen
    wrong = np.degrees(np.arctan(np.deg2rad([90.1, 95.0, 100.0])))
    assert np.allclose(seen[2:], wrong, atol=0.01), seen
    ahead = np.array([np.sin(np.deg2rad(95)), 0.0, np.cos(np.deg2rad(95))])
    assert camera.img_from_cam(ahead) is None
PROGRAM
