#!/usr/bin/env bash
# pyequilib 0.6.0, `equi2equi`, which turns a panorama: a pixel of the result gets the direction of its
# upper left corner (half a pixel too little), and a direction is looked up one pixel beyond where it is.
# So every turn also moves the picture, by half a pixel to the left and half a pixel up, and blurs it.
# `equi2pers` does the same two, of which the first is half a pixel of the view. `equi2cube` is right.
# Expected of turns by 0 degrees: the picture stays. Seen: moved by .5 pixels, after 20 turns by 10; and
# of a view of 64 columns and 90 degrees straight ahead, the centre is at column 32.3, where that of the
# front face of the cube is at 32.0.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.13.0 pyequilib==0.6.0 numpy==2.4.6
"$work/venv/bin/python" - <<'PROGRAM'
import equilib
import numpy as np

WIDTH, HEIGHT, SIZE = 1024, 512, 64
still = {"roll": 0.0, "pitch": 0.0, "yaw": 0.0}
row, column = np.mgrid[:HEIGHT, :WIDTH]
longitude = 2 * np.pi * ((column + 0.5) / WIDTH - 0.5)
latitude = np.pi * (0.5 - (row + 0.5) / HEIGHT)
panorama = np.stack(  # its own directions: x ahead, y to the right, z up
    [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
)

def moved(picture):
    """Pixels by which the content went to the left and up, at the middle of the picture."""
    x, y, z = picture[:, HEIGHT // 2, WIDTH // 2]
    place = np.array([np.arctan2(y, x) / (2 * np.pi) + 0.5, 0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi])
    return place * (WIDTH, HEIGHT) - (WIDTH // 2 + 0.5, HEIGHT // 2 + 0.5)

picture = panorama
for turns in range(1, 21):
    picture = equilib.equi2equi(src=picture, rots=still)
    if turns in (1, 20):
        print(f"turned by nothing, {turns} times: moved by {moved(picture).round(3)} pixels")
        assert np.allclose(moved(picture), turns / 2, atol=0.01), moved(picture)

def centre(view):
    """Column of the view, with areas as pixels, that looks straight ahead."""
    tangents = view[1, SIZE // 2] / view[0, SIZE // 2]
    return np.interp(0, tangents, np.arange(SIZE) + 0.5)

view = equilib.equi2pers(equi=panorama, rots=still, height=SIZE, width=SIZE, fov_x=90.0)
face = equilib.equi2cube(equi=panorama, rots=still, w_face=SIZE, cube_format="dict")["F"]
print(f"centre of {SIZE} columns: {centre(face):.3f} of the cube's face, {centre(view):.3f} of the view")
beyond = 2 * np.pi / WIDTH * SIZE / 2  # a pixel of the panorama, in pixels of the view
assert abs(centre(face) - SIZE / 2) < 0.01, centre(face)
assert abs(centre(view) - (SIZE / 2 + 0.5 - beyond)) < 0.01, centre(view)
PROGRAM
