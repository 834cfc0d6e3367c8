"""Patches aligned by Lucas and Kanade's method, from coarse to fine, in compiled code.

The gradients are those of the template, so that each patch has one normal matrix per level
(Baker and Matthews, "Lucas-Kanade 20 years on", 2004). Columns are summed apart and then in order:
results do not depend on how wide a processor's vectors are.
"""

import cv2
import numpy as np

from factors.compiled import kernel_and_part

_kernel, _part = kernel_and_part()
WINDOW = 16  # pixels across a patch
LEVELS = 3  # halvings of a picture
_ITERATIONS = 15
_MIN_STEP_PX, _MIN_COARSE_STEP_PX = 0.02, 0.1  # iterations end below it; on halved pictures
_MIN_EIGENVALUE = 0.1  # mean of a patch's gradients squared, (grey values / pixel)^2


def pyramid(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """A picture (h, w) uint8 and its halvings, as float32."""
    levels = [image]
    for _ in range(LEVELS):
        levels.append(cv2.pyrDown(levels[-1]))
    return tuple(level.astype(np.float32) for level in levels)


def align_patches(
    template: tuple[np.ndarray, ...],
    picture: tuple[np.ndarray, ...],
    starts: np.ndarray,
    guesses: np.ndarray,
    levels: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels (N, 2) of one picture's patches in another, which (N,) bool were aligned, and the mean
    difference (N,) of both patches, grey values.

    Args:
        template, picture: see `pyramid`, of one size.
        starts, guesses: (N, 2) OpenCV pixels of patches in `template`, and where they are
            expected.
        levels: halvings to begin at, at most `LEVELS`.
    """
    starts, ends = np.asarray(starts, float), np.array(guesses, float)
    aligned, difference = np.zeros(len(starts), bool), np.zeros(len(starts))
    if len(starts):
        _align(template, picture, starts, ends, levels, WINDOW, aligned, difference)
    return ends, aligned, difference


@_part
def _sample(image, u, v, out):
    """The part of a picture, as large as `out`, whose top left pixel is (u, v); whether inside."""
    rows, columns = out.shape
    left, top = int(np.floor(u)), int(np.floor(v))
    if left < 0 or top < 0 or left + columns >= image.shape[1] or top + rows >= image.shape[0]:
        return False
    a, b, one = np.float32(u - left), np.float32(v - top), np.float32(1.0)
    w00, w01, w10, w11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    x, y, next_one = np.uintp(left), np.uintp(top), np.uintp(1)  # unsigned: never from the end
    for j in range(np.uintp(rows)):
        for i in range(np.uintp(columns)):
            above = w00 * image[y + j, x + i] + w01 * image[y + j, x + i + next_one]
            below = w10 * image[y + j + next_one, x + i]
            out[j, i] = above + (below + w11 * image[y + j + next_one, x + i + next_one])
    return True


@_part
def _differentiate(wide, patch, by_u, by_v, columns, sums):
    """Patch and gradients from a patch with a border of a pixel; sums (3,) of their products."""
    half, size, one, two = np.float32(0.5), np.uintp(len(patch)), np.uintp(1), np.uintp(2)
    columns[:] = 0
    for j in range(size):
        for i in range(size):
            patch[j, i] = wide[j + one, i + one]
            by_u[j, i] = half * (wide[j + one, i + two] - wide[j + one, i])
            by_v[j, i] = half * (wide[j + two, i + one] - wide[j, i + one])
    for j in range(size):
        for i in range(size):
            columns[0, i] += by_u[j, i] * by_u[j, i]
            columns[1, i] += by_u[j, i] * by_v[j, i]
            columns[2, i] += by_v[j, i] * by_v[j, i]
    for k in range(3):
        sums[k] = 0.0
        for i in range(size):
            sums[k] += columns[k, i]


@_part
def _differ(moved, patch, by_u, by_v, columns, sums):
    """Sums (2,) of the difference of two patches times gradients."""
    size = np.uintp(len(patch))
    columns[:2] = 0
    for j in range(size):
        for i in range(size):
            off = moved[j, i] - patch[j, i]
            columns[0, i] += off * by_u[j, i]
            columns[1, i] += off * by_v[j, i]
    for k in range(2):
        sums[k] = 0.0
        for i in range(size):
            sums[k] += columns[k, i]


@_kernel
def _align(template, picture, starts, ends, levels, window, aligned, difference):
    """Move `ends` (N, 2) to where patches of `window` pixels around `starts` (N, 2) are."""
    half, area = 0.5 * (window - 1), float(window * window)
    wide = np.empty((window + 2, window + 2), np.float32)
    patch = np.empty((window, window), np.float32)
    by_u, by_v, moved = np.empty_like(patch), np.empty_like(patch), np.empty_like(patch)
    columns, sums, steps = np.empty((3, window), np.float32), np.zeros(3), np.zeros(2)
    for n in range(len(starts)):
        u, v = ends[n, 0] / 2.0**levels, ends[n, 1] / 2.0**levels
        for level in range(levels, -1, -1):
            if level < levels:
                u, v = 2.0 * u, 2.0 * v
            scale = 1.0 / 2.0**level
            left, top = starts[n, 0] * scale - half, starts[n, 1] * scale - half
            if not _sample(template[level], left - 1.0, top - 1.0, wide):
                continue
            _differentiate(wide, patch, by_u, by_v, columns, sums)
            uu, uv, vv = sums[0] / area, sums[1] / area, sums[2] / area
            least = 0.5 * (uu + vv - np.sqrt((uu - vv) * (uu - vv) + 4.0 * uv * uv))
            if least < _MIN_EIGENVALUE:
                continue
            enough = _MIN_COARSE_STEP_PX if level else _MIN_STEP_PX
            determinant = uu * vv - uv * uv
            inside, before_u, before_v = False, 0.0, 0.0
            for iteration in range(_ITERATIONS):
                inside = _sample(picture[level], u - half, v - half, moved)
                if not inside:
                    break
                _differ(moved, patch, by_u, by_v, columns, steps)
                across, down = steps[0] / area, steps[1] / area
                step_u = (uv * down - vv * across) / determinant
                step_v = (uv * across - uu * down) / determinant
                u, v = u + step_u, v + step_v
                if step_u * step_u + step_v * step_v < enough * enough:
                    break
                back = abs(step_u + before_u) < 0.01 and abs(step_v + before_v) < 0.01
                if iteration and back:  # to and fro between two places
                    u, v = u - 0.5 * step_u, v - 0.5 * step_v
                    break
                before_u, before_v = step_u, step_v
            if level == 0 and inside and _sample(picture[0], u - half, v - half, moved):
                off = 0.0
                for j in range(window):
                    for i in range(window):
                        off += abs(moved[j, i] - patch[j, i])
                difference[n] = off / area
                aligned[n] = True
        if aligned[n]:
            ends[n, 0], ends[n, 1] = u, v
