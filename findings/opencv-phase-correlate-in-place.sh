#!/usr/bin/env bash
# OpenCV 5.0.0.93, `cv2.phaseCorrelate(first, second, window)`: it multiplies both of its input images by the
# window, in place, where height and width have no other factors than 2, 3 and 5, as 640x480, 1280x720 and
# 1920x1080. Images of other sizes are copied (padded) first, and stay as they are.
# Expected: unchanged inputs. Seen: after one call both frames are dark towards their edges (the top tenth goes
# from a mean grey of 128 to 12), and a frame that others are compared to gets darker with each call: 127, 51,
# 32, 23. The shifts are right; exposures, sharpness and features that are taken from the frames afterwards are
# not: 67 % of the corners are lost. At 638x478 nothing changes.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import cv2
import numpy as np

def frames(width, height):
    """Four frames of a camera that moves by 2 pixels to the right, and a window for them."""
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.uniform(size=(height, width + 6)), (0, 0), 0.8)
    scene = np.float32(255 * (scene - scene.min()) / (scene.max() - scene.min()))
    moving = [np.ascontiguousarray(scene[:, 2 * n : 2 * n + width]) for n in range(4)]
    return moving, cv2.createHanningWindow((width, height), cv2.CV_32F)

def corners(frame):
    return len(cv2.goodFeaturesToTrack(np.uint8(frame), 100000, 0.1, 5))

for width, height in ((640, 480), (1280, 720), (638, 478)):
    (reference, *others), window = frames(width, height)
    greys, before, many = [reference.mean()], reference.copy(), corners(reference)
    for step, frame in enumerate(others, 1):
        (right, down), _ = cv2.phaseCorrelate(frame, reference, window)
        assert abs(right - 2 * step) < 0.1 and abs(down) < 0.1, (right, down)
        greys.append(reference.mean())
        if step == 1:
            few, rim = corners(reference), reference[: height // 10].mean()
    top = before[: height // 10].mean()
    print(f"{width}x{height}: mean grey {np.round(greys, 1)}, top tenth {top:.1f} then {rim:.1f}; "
          f"{many} corners, {few} after one call")
    if width == 638:
        assert np.array_equal(reference, before)
    else:
        assert greys[1] < 0.5 * greys[0] and greys[3] < 0.25 * greys[0], greys
        assert np.allclose(reference, before * window**3, atol=1e-3)
        assert rim < 20 and few < 0.5 * many, (rim, many, few)
PROGRAM
