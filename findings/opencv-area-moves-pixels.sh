#!/usr/bin/env bash
# OpenCV 5.0.0.93: `cv2.resize(..., INTER_AREA)` by a factor that is no integer moves pixels of the
# result by up to 1/18 pixel, every other one to the other side: a source pixel counts with its
# centre, however little of it lies below. Shrunk by 2 or 3, all are where they should be.
# That is twice the noise of the best places that a bundle adjustment of pixels finds.
# Seen: a ramp shrunk by 3 / 2 is off by 0.056 and -0.056 pixels in turn; by 2 and 3 by 0.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet opencv-python-headless==5.0.0.93 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import cv2
import numpy as np

WIDTH = 3600
ramp = np.tile(np.arange(WIDTH, dtype=np.float32) + 0.5, (WIDTH // 2, 1))  # places of columns
off = {}
for factor in (1.5, 2, 3):
    size = round(WIDTH / factor), round(WIDTH / 2 / factor)
    seen = cv2.resize(ramp, size, interpolation=cv2.INTER_AREA)[100]
    off[factor] = seen / factor - (np.arange(size[0]) + 0.5)
    print(f"shrunk by {factor}: columns 100 to 105 are off by", off[factor][100:106].round(4), "px")
assert abs(off[2]).max() < 1e-3 and abs(off[3]).max() < 1e-3
assert np.allclose(off[1.5][100:200:2], -off[1.5][101:200:2], atol=1e-3)
assert abs(abs(off[1.5][100]) - 1 / 18) < 1e-3, off[1.5][100]
PROGRAM
