"""The overlap of a raw pair's pictures at their rims: they agree at the seam under the right
quarter turn of the back lens and the focal length that puts the seam at 90 degrees."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsba.camera.fisheye import Pair, project
from gsba.types import Fisheye

_MAX_WIDTH_PX = 1024  # sufficient width of a picture, pixels
_NUM_AROUND = 720  # places along the seam
_OVERLAP_RAD = np.deg2rad(np.arange(-4.0, 4.5, 1.0))  # angles from the seam
_SCALES = 100.0 / np.arange(90.0, 112.25, 0.5)[::-1]  # of focal lengths: circles of 90 to 112
# degrees from the axis, where they are taken for 100
_PEAK_HALF_WIDTH = 5  # steps of _SCALES on either side of the peak, where the correlation must be
# lower


def measure_overlap(
    looks: Sequence[Sequence[np.ndarray]],
    front: Fisheye,
    behind: Sequence[Fisheye],
    radii: tuple[float, float],
) -> tuple[int | None, float | None]:
    """Index of the back lens whose pictures continue the front one's at the seam, None = no one
    matches clearly better than all others; and the scale of focal lengths at which they correlate
    best, None = undetermined.

    Args:
        looks: pictures (h, w) uint8 of both lenses of each frame.
        behind: back lenses, one for each turn about the axis that it may have.
        radii: radii of both image circles, pixels.
    """
    share = min(1.0, _MAX_WIDTH_PX / front.width)
    front, behind = _shrunk(front, share), [_shrunk(lens, share) for lens in behind]
    radii, size = (share * radii[0], share * radii[1]), (front.width, front.height)
    sigma = front.focal / _NUM_AROUND * np.pi
    fronts, backs = ([_smooth(pictures[n], size, sigma) for pictures in looks] for n in range(2))
    whole, fine = (np.full((len(behind), len(_SCALES)), -1.0) for _ in range(2))
    for s, scale in enumerate(_SCALES):
        # Directions (R, A, 3) around the seam inside of both image circles, whose rims are dark
        ring = np.array([[np.sin(a), np.cos(a)] for a in np.pi / 2 + np.abs(_OVERLAP_RAD)])
        meridian = np.stack([ring[:, 0], np.zeros(len(ring)), ring[:, 1]], axis=1)
        plain = replace(_scaled(front, scale), rotation=(0.0, 0.0, 0.0))
        reach = np.linalg.norm(project(plain, meridian) - np.asarray(front.principal), axis=1)
        ring = _rings(np.pi / 2 + _OVERLAP_RAD[reach < 0.985 * min(radii)])
        if len(ring) < 5:  # least number of rows of _OVERLAP_RAD inside both image circles
            continue
        ahead = _harmonics(fronts, _scaled(front, scale), ring)
        for t, lens in enumerate(behind):
            back = _harmonics(backs, _scaled(lens, scale), ring)
            whole[t, s] = np.mean([_correlation(a, b, 1) for a, b in zip(ahead, back, strict=True)])
            # Harmonics below 3 are sky and ground at any focal length.
            fine[t, s] = np.mean([_correlation(a, b, 3) for a, b in zip(ahead, back, strict=True)])
    best = whole.max(axis=1)
    order = np.argsort(best)[::-1]
    turn = int(order[0])
    clear = len(behind) == 1 or bool(best[turn] > best[order[1]] + 0.1)
    return turn if clear else None, _peak(fine[turn])


def rim_likeness(looks: Sequence[Sequence[np.ndarray]], pair: Pair) -> float:
    """Mean correlation of both lenses' pictures around the seam, about 1 for correct lenses; looks:
    pictures (h, w) uint8 of both lenses of each frame."""
    share = min(1.0, _MAX_WIDTH_PX / pair[0].width)
    front, back = (_shrunk(lens, share) for lens in pair)
    size, sigma = (front.width, front.height), front.focal / _NUM_AROUND * np.pi
    ring = _rings(np.pi / 2 + _OVERLAP_RAD)
    ahead, behind = (
        _harmonics([_smooth(pictures[n], size, sigma) for pictures in looks], lens, ring)
        for n, lens in enumerate((front, back))
    )
    return float(np.mean([_correlation(a, b, 1) for a, b in zip(ahead, behind, strict=True)]))


def scaled(pair: Pair, scale: float) -> Pair:
    """Both lenses with focal lengths multiplied by `scale`."""
    return _scaled(pair[0], scale), _scaled(pair[1], scale)


def _shrunk(lens: Fisheye, share: float) -> Fisheye:
    """The lens in pictures scaled by `share`."""
    x, y = lens.principal
    width, height = round(share * lens.width), round(share * lens.height)
    at = (share * x, share * y)
    return replace(lens, width=width, height=height, focal=share * lens.focal, principal=at)


def _smooth(picture: np.ndarray, size: tuple[int, int], sigma: float) -> np.ndarray:
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), sigma)


def _scaled(lens: Fisheye, scale: float) -> Fisheye:
    return replace(lens, focal=lens.focal * scale)


def _rings(angles: np.ndarray) -> np.ndarray:
    """Directions (R, A, 3) at angles (R,) from the front lens's axis, all around it."""
    longitudes = np.linspace(0, 2 * np.pi, _NUM_AROUND, endpoint=False)
    out = np.empty((len(angles), _NUM_AROUND, 3))
    out[..., 0] = np.sin(angles)[:, None] * np.cos(longitudes)
    out[..., 1] = np.sin(angles)[:, None] * np.sin(longitudes)
    out[..., 2] = np.cos(angles)[:, None]
    return out


def _harmonics(pictures: Sequence[np.ndarray], lens: Fisheye, ring: np.ndarray) -> list[np.ndarray]:
    """Fourier coefficients (R, A / 2 + 1) of each picture's brightness along rings of
    directions."""
    places = (project(lens, ring) - 0.5).astype(np.float32)
    u, v = places[..., 0], places[..., 1]
    seen = (cv2.remap(picture, u, v, cv2.INTER_LINEAR) for picture in pictures)
    return [np.fft.rfft(brightness.astype(np.float64), axis=1) for brightness in seen]


def _correlation(one: np.ndarray, other: np.ndarray, lowest: int) -> float:
    """Correlation of two pictures by their coefficients from the harmonic `lowest` on."""
    a, b = one[:, lowest:], other[:, lowest:]
    product = float(np.sum(np.real(a * np.conj(b))))
    return product / float(np.sqrt(max(np.sum(np.abs(a) ** 2) * np.sum(np.abs(b) ** 2), 1e-12)))


def _peak(scores: np.ndarray) -> float | None:
    """Scale of focal lengths at a clear peak of correlations (S,); None = there is none."""
    best = int(np.argmax(scores))
    sides = best - _PEAK_HALF_WIDTH, best + _PEAK_HALF_WIDTH
    if sides[0] < 0 or sides[1] >= len(scores) or scores[best] < 0.25:
        return None
    if max(scores[list(sides)]) > 0.87 * scores[best]:
        return None
    before, at, after = scores[best - 1 : best + 2]
    bend = before - 2 * at + after
    between = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(np.interp(best + between, np.arange(len(_SCALES)), _SCALES))
