"""Detection of 2:1 pictures that are no panorama: stereo pairs and cropped panoramas.

Thresholds lie beyond the extremes of 5,159 pictures of true panoramas, blurred, dark, overexposed,
with seams 1 degree off, carriers and patches over the poles: none is refused. Of 38 sequences of
each kind of stereo none is accepted; of those cropped to 270 x 135 degrees nine in ten are
recognised.
"""

from collections.abc import Iterable

import cv2
import numpy as np

NUM_LOOKS = 5  # pictures of a sequence that suffice
SIDE_BY_SIDE = "stereo, an eye on the left and one on the right"
VR180 = "stereo side by side of half the sphere each (VR180)"
OVER_UNDER = "stereo, one eye above the other"
CROPPED = "a cropped panorama: its left and right edge do not meet"
REMEDIES = {  # of what `unlike_panorama` names
    SIDE_BY_SIDE: "cut out the left half and scale it to 2:1, if it shows the whole sphere",
    VR180: "half the sphere is missing; gsba needs 360-degree panoramas",
    OVER_UNDER: "cut out the upper half and scale it to 2:1",
    CROPPED: "pad it with black to 360 x 180 degrees, or keep the GPano tags of its maker",
}

_WIDTH = 256  # pixels across, to which pictures are made smaller
_MIN_LIT_LEVEL, _LIT_BORDER_PX = 16, 13  # black areas and their edges repeat without stereo
_MIN_REPEAT = 0.65  # correlation of the details of both eyes; 0.46 at most in panoramas
_MIN_SEAM = 0.5  # step between both edges over that between far columns
_MIN_SEAM_OF_HALVES = 0.4  # the same where halves repeat: tells half spheres from whole ones
_MIN_MIDDLE_STEP = 1.1  # one eye's nadir does not continue in the other's zenith
_MIN_TORN = 0.5  # median step between edges that are shifted and scaled to meet; 0.16 at most in
# sequences of true panoramas, badly stitched ones included
_MIN_TORN_LOOKS = 3  # pictures; of single ones, somebody who stands on the edge tears one in 400
_MAX_SHIFT_PX, _MAX_GAIN = 4, 1.4  # between edges that two lenses saw
_MIN_POLE_DETAIL = 0.45  # gradient along the rows over that across them; 0.44 at most at the more
# constant pole of panoramas whose edges do not meet
_POLE_ROWS, _POLE_SIGMA_PX, _MIN_GRADIENT = 6, 1.5, 0.3  # rows; blur; grey levels a pixel
_MIN_CONTRAST = 6.0  # grey levels between far columns; with less, noise is compared


def unlike_panorama(greys: Iterable[np.ndarray]) -> str:
    """Name of what 2:1 pictures hold instead of panoramas; "" = nothing speaks against panoramas.
    `greys`: (h, w) uint8 each, of one sequence; NUM_LOOKS suffice, and fewer are taken if the first
    one is clearly a panorama. Those narrower than 512 pixels are not judged."""
    found = list[tuple[float, ...]]()
    for grey in greys:
        # noise of smaller pictures is not averaged
        if grey.shape[1] < 512:
            return ""
        found.append(_measure(grey))
        beside, above, seam, *_ = found[0]
        # edges meet, so that one picture is enough
        if max(beside, above) < _MIN_REPEAT and seam < 0.3:
            return ""
    if not found:
        return ""
    beside, above, seam, poles, torn, middle = np.median(found, axis=0)
    if beside >= max(_MIN_REPEAT, above):
        of_contrast = [step for _, _, step, *_ in found if step > 0]
        whole = not of_contrast or np.median(of_contrast) < _MIN_SEAM_OF_HALVES
        return SIDE_BY_SIDE if whole else VR180
    if above >= _MIN_REPEAT and middle >= _MIN_MIDDLE_STEP:
        return OVER_UNDER
    no_poles = seam >= _MIN_SEAM and poles >= _MIN_POLE_DETAIL
    cropped = no_poles or (torn >= _MIN_TORN and len(found) >= _MIN_TORN_LOOKS)
    return CROPPED if cropped else ""


def _measure(grey: np.ndarray) -> tuple[float, ...]:
    """Correlations of the left with the right half and of the upper with the lower one; step
    between both edges over that between far columns, medians over rows, 0 = no contrast; detail of
    the more constant pole; that step with edges shifted along each other and scaled so that they
    meet best; and step between the middle rows over the 95th percentile of steps between rows."""
    size = _WIDTH, _WIDTH // 2
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    # blur whose difference from a picture is its detail
    detail = small - cv2.GaussianBlur(small, (0, 0), 6.0)
    border = np.ones((_LIT_BORDER_PX, _LIT_BORDER_PX), np.uint8)
    lit = cv2.erode((small > _MIN_LIT_LEVEL).astype(np.uint8), border) > 0
    beside, above = (
        _repeat(*np.split(detail, 2, axis), *np.split(lit, 2, axis)) for axis in (1, 0)
    )
    columns = cv2.blur(small, (1, 5))
    shifts = (_WIDTH * np.array([3, 5, 7, 8])) // 16
    far = np.mean([np.median(np.abs(columns - np.roll(columns, s, 1))) for s in shifts])
    seam = np.median(np.abs(columns[:, 0] - columns[:, -1])) / far if far > _MIN_CONTRAST else 0.0
    blurred = cv2.GaussianBlur(small, (0, 0), _POLE_SIGMA_PX, borderType=cv2.BORDER_REPLICATE)
    poles = min(_pole_detail(blurred[:_POLE_ROWS]), _pole_detail(blurred[-_POLE_ROWS:]))
    steps = np.abs(np.diff(small, axis=0)).mean(axis=1)
    middle = float(steps[len(steps) // 2] / max(np.percentile(steps, 95), 1e-6))
    torn = _torn(columns, shifts) if far > _MIN_CONTRAST else 0.0
    return beside, above, float(seam), poles, torn, middle


def _torn(columns: np.ndarray, shifts: np.ndarray) -> float:
    """Step between the last and the first of columns (h, w) over that between columns `shifts` (S,)
    apart, each between columns that are shifted and scaled so that they meet best."""
    last, width = np.arange(0, columns.shape[1], columns.shape[1] // 8), columns.shape[1]
    left, right = np.append(np.repeat(last, len(shifts)), width - 1), np.tile(shifts, len(last))
    right = np.append((left[:-1] + right) % width, 0)
    one, other = columns[:, left] + 1, columns[:, right] + 1
    most, steps = _MAX_SHIFT_PX, []
    inner = one[most:-most]
    for shift in range(2 * most + 1):
        moved = other[shift : len(other) - 2 * most + shift]
        gains = np.median(inner, axis=0) / np.median(moved, axis=0)
        scaled = np.clip(gains, 1 / _MAX_GAIN, _MAX_GAIN) * moved
        steps.append(np.median(np.abs(inner - scaled), axis=0))
    best = np.min(steps, axis=0)
    return float(best[-1] / max(best[:-1].mean(), 1e-6))


def _repeat(one: np.ndarray, other: np.ndarray, lit: np.ndarray, other_lit: np.ndarray) -> float:
    """Largest correlation of two halves (h, w) over shifts of some columns; 0 = not comparable."""
    most, best = 6, 0.0  # pixels between two eyes
    inner = (slice(None), slice(most, -most))
    for shift in range(-most, most + 1):
        both = (lit & np.roll(other_lit, shift, 1))[inner]
        # part of a half that must be lit in both
        if both.mean() < 0.2:
            continue
        x, y = one[inner][both], np.roll(other, shift, 1)[inner][both]
        norm = float(x.std() * y.std())
        if norm > 1:  # with less than one grey level, noise or nothing is compared
            best = max(best, float(((x - x.mean()) * (y - y.mean())).mean()) / norm)
    return best


def _pole_detail(rows: np.ndarray) -> float:
    """Mean gradient along rows at a pole over that across them; 0 = nothing to be seen there.

    In a panorama the ratio is the cosine of the latitude, a few per cent, and more with noise.
    """
    along = float(np.abs(np.diff(rows[:-1, 1:-1], axis=1)).mean())
    across = float(np.abs(np.diff(rows[:, 1:-1], axis=0)).mean())
    return along / across if along > _MIN_GRADIENT and across > 0 else 0.0
