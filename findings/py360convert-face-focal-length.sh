#!/usr/bin/env bash
# py360convert 1.0.4, faces and perspective views of a panorama: their field of view reaches from
# the centre of the first pixel to the centre of the last one. A face of 90 degrees and w pixels has
# a focal length of (w - 1) / 2, not w / 2 as every trainer and COLMAP take of 90 degrees: pixels at
# the edges are half a pixel off, and neighbouring faces share a column. Of a panorama itself, pixels
# are areas (the first column's centre is half a pixel in), so that the two conventions meet here.
# Expected of faces of 64 pixels: rays at tangents -63/64 to 63/64, focal length 32. Seen: -1 to 1,
# focal length 31.5, from e2c as from e2p.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet py360convert==1.0.4 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import numpy as np
import py360convert

WIDTH, HEIGHT, SIZE = 1024, 512, 64
longitude = 2 * np.pi * ((np.arange(WIDTH) + 0.5) / WIDTH - 0.5)
latitude = np.pi * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None]
panorama = np.stack(  # its own directions: x right, y down, z ahead
    [
        np.cos(latitude) * np.sin(longitude),
        np.broadcast_to(-np.sin(latitude), (HEIGHT, WIDTH)),
        np.cos(latitude) * np.cos(longitude),
    ],
    axis=-1,
)
face = py360convert.e2c(panorama, face_w=SIZE, mode="bilinear", cube_format="dict")["F"]
view = py360convert.e2p(panorama, (90, 90), 0, 0, (SIZE, SIZE), mode="bilinear")
for name, picture in (("e2c", face), ("e2p", view)):
    row = picture[SIZE // 2]
    tangents = row[:, 0] / row[:, 2]
    focal = 1 / np.median(np.diff(tangents))
    print(f"{name}: tangents {tangents[0]:.4f} to {tangents[-1]:.4f}, focal length {focal:.3f}")
    assert np.allclose(tangents[[0, -1]], [-1, 1], atol=1e-4), tangents
    assert abs(focal - (SIZE - 1) / 2) < 0.01, focal
PROGRAM
