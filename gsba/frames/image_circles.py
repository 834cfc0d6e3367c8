"""Image circles of fisheyes: the strongest drop of brightness along most rays from the middle, at
any level of stray light, in the median of several pictures. A circle through edges of three rays is
tried many times; the one that most rays agree with is refined."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from gsba.geometry import unit
from gsba.log import GsbaError
from gsba.types.records import slices

_DARK_OFFSET = 8.0  # grey values added before the logarithm: noise of black pixels is no edge
_ANGLES = 2 * np.pi * (np.arange(360) + 0.5) / 360  # of rays around the middle of a picture
_SAMPLE_STEP_PX = 0.5  # pixels along a ray
_WINDOW_SAMPLES = 6  # samples on either side of an edge, whose means are compared
_MIN_EDGE_GAP = 8  # samples between two edges of a ray
_NUM_TRIALS = 3000  # circles tried, each through three edges
_MAX_REFINED_DISTANCE = 0.01  # largest distance of an edge while the circle is refined, relative
_MIN_RADIUS, _MAX_RADIUS = 0.3, 0.72  # in units of the shorter and of the longer side
_MAX_OFF_CENTRE = 0.15  # distance of the centre from the middle, in units of each side
_BORDER_PX = 1.5  # pixels at the picture's border in which edges are ignored
_MIN_SUPPORT = 0.5  # share of the visible rim on which an edge must lie
_MIN_AGREEING_RAYS = 54  # rays that must have an edge on the circle
_INNER_RADII = 0.75, 0.97  # range of radii of a circle within a housing's, relative to the outer
# one
_TEXTURE_BLUR_PX, _TEXTURE_PARTS = 1.5, 12  # pixels; parts of a circle over which the mean is
# removed
_CORRELATED_RAYS = 8  # neighbouring rays with correlated errors


@dataclass(frozen=True, slots=True)
class ImageCircle:
    """The disc of a picture that a lens lights."""

    x: float  # centre, pixels, corner origin
    y: float
    radius: float  # pixels
    support: float = 1.0  # share of the rim inside the picture on which an edge lies
    sigma: float = 0.0  # pixels, standard deviation of the radius and of the centre

    def scaled(self, factor: float) -> "ImageCircle":
        """The circle in a picture of `factor` times the resolution."""
        x, y, radius, sigma = (factor * v for v in (self.x, self.y, self.radius, self.sigma))
        return ImageCircle(x, y, radius, self.support, sigma)


def given_circles(
    circles: Sequence[tuple[float, float, float]], calibration: Path | None
) -> tuple[ImageCircle, ...]:
    """Image circles of the front and the back lens, or one of both, as a caller gives them;
    GsbaError for more than two, what is no circle, or a calibration as well."""
    if not circles:
        return ()
    if calibration is not None:
        raise GsbaError(
            f"--circle and --calibration {calibration} both say where image circles are: pass one"
        )
    if len(circles) > 2:
        raise GsbaError(f"--circle: {len(circles)} are given; a camera of two lenses has two")
    for circle in circles:
        if len(circle) != 3 or not np.isfinite(circle).all() or circle[2] <= 0:
            said = ",".join(f"{value:g}" for value in circle)
            raise GsbaError(f"--circle {said}: give X,Y,R: a centre and a positive radius, pixels")
    return tuple(ImageCircle(*map(float, circle)) for circle in circles)


@dataclass(frozen=True, slots=True)
class CircleSearch:
    """The result of a search for an image circle."""

    best: ImageCircle | None  # the best candidate; None = no edges were found
    num_rays: int  # rays that agree with it
    found: bool  # True if it is an image circle
    middle_grey: int  # median of the middle of the picture
    corner_grey: int  # median of its corners

    @property
    def circle(self) -> ImageCircle | None:
        """The image circle; None = the pictures show none."""
        return self.best if self.found else None

    def sighting(self) -> str:
        """Description of the best candidate, for a message."""
        seen = f"median grey {self.middle_grey} in the middle, {self.corner_grey} in the corners"
        if self.best is None:
            return f"{seen}; no edges around the middle"
        x, y, radius = self.best.x, self.best.y, self.best.radius
        return (
            f"{seen}; best candidate: radius {radius:.0f} around ({x:.0f}, {y:.0f}), an edge on "
            f"{self.best.support:.0%} of its rim"
        )


def find_circle(pictures: Sequence[np.ndarray]) -> CircleSearch:
    """Find the image circle of a lens. `pictures`: (h, w) uint8 each, of one lens, of one size; 5
    to 10 from all over the capture."""
    height, width = pictures[0].shape
    scale = min(1.0, 512 / max(height, width))
    size = max(round(scale * width), 8), max(round(scale * height), 8)
    small = [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures]
    median = np.median(small, axis=0).astype(np.float32)
    smooth = cv2.GaussianBlur(median, (0, 0), 1.0)
    best, num_rays = _best_circle(_edges(smooth), small)
    if best is not None:
        best = best.scaled(width / size[0])
    found = best is not None and best.support >= _MIN_SUPPORT and num_rays >= _MIN_AGREEING_RAYS
    # Median grey values of the middle and of the corners of a picture (h, w)
    height, width = median.shape
    down, across = max(height // 12, 1), max(width // 12, 1)
    middle = median[4 * down : -4 * down, 4 * across : -4 * across]
    ends = [median[rows][:, columns] for rows in (slice(down), slice(-down, None))
            for columns in (slice(across), slice(-across, None))]  # fmt: skip
    greys = (round(float(np.median(some))) for some in (middle, ends))
    return CircleSearch(best, num_rays, found, *greys)


@dataclass(frozen=True, slots=True)
class _Edges:
    """Edges at which brightness drops along rays from the middle of a picture."""

    places: np.ndarray  # (E, 2) float64, pixels, corner origin
    drops: np.ndarray  # (E,) float64, of the logarithm of the grey value, at most 1
    rays: np.ndarray  # (E,) int64


def _edges(smooth: np.ndarray) -> _Edges:
    """The strongest relative drops of brightness along each ray of a picture (h, w)."""
    height, width = smooth.shape
    reach = np.arange(
        0.5 * _MIN_RADIUS * min(height, width), np.hypot(height, width) / 2, _SAMPLE_STEP_PX
    )
    across = width / 2 + reach * np.cos(_ANGLES)[:, None]
    down = height / 2 + reach * np.sin(_ANGLES)[:, None]
    inside = _inside(across, down, smooth.shape, _BORDER_PX)
    values = _sampled(smooth, across, down)
    logs = np.log(values + _DARK_OFFSET)
    sums = np.cumsum(np.pad(logs, ((0, 0), (1, 0))), axis=1)
    means = (sums[:, _WINDOW_SAMPLES:] - sums[:, :-_WINDOW_SAMPLES]) / _WINDOW_SAMPLES
    drops = means[:, :-_WINDOW_SAMPLES] - means[:, _WINDOW_SAMPLES:]
    drops[~inside[:, 2 * _WINDOW_SAMPLES - 1 :]] = 0.0
    every, found = np.arange(len(_ANGLES)), []
    for _ in range(3):  # edges of a ray
        at = np.argmax(drops, axis=1)
        depth = drops[every, at]
        # of the logarithm of the grey value at an edge
        for ray in np.flatnonzero(depth >= 0.25):
            profile = values[ray, at[ray] : at[ray] + 2 * _WINDOW_SAMPLES]
            # Position in samples at which a falling profile (n,) is midway between its ends: blur
            # moves the steepest place of its logarithm outwards
            level = 0.5 * (profile[:2].mean() + profile[-2:].mean())
            after = int(np.argmax(profile < level))
            before = max(after - 1, 0)
            step = profile[before] - profile[after]
            radius = reach[at[ray]] + _SAMPLE_STEP_PX * (
                before + float((profile[before] - level) / step) if step > 0 else len(profile) / 2
            )
            found.append((radius, depth[ray], ray))
            drops[ray, max(at[ray] - _MIN_EDGE_GAP, 0) : at[ray] + _MIN_EDGE_GAP + 1] = 0.0
    radii, depths, rays = np.array(found).reshape(-1, 3).T
    rays = rays.astype(np.int64)
    away = np.stack([np.cos(_ANGLES[rays]), np.sin(_ANGLES[rays])], axis=1)
    places = np.array([width / 2, height / 2]) + radii[:, None] * away
    return _Edges(places, np.minimum(depths, 1.0), rays)  # deeper drops gain no more weight


def _best_circle(edges: _Edges, pictures: Sequence[np.ndarray]) -> tuple[ImageCircle | None, int]:
    """Circle on which most rays have an edge, in a housing the scene's, and these rays' number."""
    height, width = pictures[0].shape
    circles = _trials(edges.places, width, height)
    if not len(circles):
        return None, 0
    scores = np.empty(len(circles))
    for some in slices(len(circles), 250):
        x, y, radii = (circles[some, k, None] for k in range(3))
        away = np.hypot(edges.places[:, 0] - x, edges.places[:, 1] - y)
        scores[some] = (np.abs(away - radii) < 0.006 * radii) @ edges.drops
    best = int(np.argmax(scores))
    outer = circles[best]
    parts = circles[:, 2] / outer[2]
    apart = np.hypot(*(circles[:, :2] - outer[:2]).T) / outer[2]
    within = (parts > _INNER_RADII[0]) & (parts < _INNER_RADII[1]) & (apart < 0.03)
    within &= scores > 0.4 * scores[best]
    if within.any():
        inner = circles[int(np.argmax(np.where(within, scores, -1.0)))]
        between = outer - 0.5 * (outer - inner)
        scene = inner * np.array([1.0, 1.0, 0.93])
        # a housing has little contrast beside the scene within it
        if _contrast(pictures, between) < 0.6 * _contrast(pictures, scene):
            outer = inner
    return _refined(edges, outer, width, height)


def _trials(places: np.ndarray, width: int, height: int) -> np.ndarray:
    """Candidate circles (C, 3), x y radius, each through three edges."""
    if len(places) < _MIN_AGREEING_RAYS:
        return np.zeros((0, 3))
    rng = np.random.default_rng(0)  # the same circles in every run
    a, b, c = (places[rng.integers(len(places), size=_NUM_TRIALS)] for _ in range(3))
    b, c = b - a, c - a
    twice = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    squares_b, squares_c = np.sum(b * b, axis=1), np.sum(c * c, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (c[:, 1] * squares_b - b[:, 1] * squares_c) / twice
        y = (b[:, 0] * squares_c - c[:, 0] * squares_b) / twice
    circles = np.column_stack([a[:, 0] + x, a[:, 1] + y, np.hypot(x, y)])
    off = np.abs(circles[:, :2] - np.array([width, height]) / 2)
    with np.errstate(invalid="ignore"):
        good = (off < _MAX_OFF_CENTRE * np.array([width, height])).all(axis=1)
        good &= circles[:, 2] > _MIN_RADIUS * min(width, height)
        good &= circles[:, 2] < _MAX_RADIUS * max(width, height)
    return circles[good]


def _refined(edges: _Edges, circle: np.ndarray, width: int, height: int) -> tuple[ImageCircle, int]:
    """The circle fitted to all edges near a circle (3,), and the number of rays with such edges."""
    x, y, radius = circle
    for _ in range(8):
        away = np.hypot(edges.places[:, 0] - x, edges.places[:, 1] - y) - radius
        near = np.abs(away) < _MAX_REFINED_DISTANCE * radius
        if np.count_nonzero(near) < _MIN_AGREEING_RAYS // 2:
            break
        at, weights = edges.places[near], np.sqrt(edges.drops[near])
        columns = np.column_stack([2 * at, np.ones(len(at))]) * weights[:, None]
        right = weights * np.sum(at**2, axis=1)
        (x, y, rest), *_ = np.linalg.lstsq(columns, right, rcond=None)
        radius = float(np.sqrt(max(rest + x * x + y * y, 1e-9)))
    away = np.hypot(edges.places[:, 0] - x, edges.places[:, 1] - y) - radius
    near = np.abs(away) < _MAX_REFINED_DISTANCE * radius
    num = len(np.unique(edges.rays[near]))
    across, down = x + radius * np.cos(_ANGLES), y + radius * np.sin(_ANGLES)
    visible = _inside(across, down, (height, width), 2 * _BORDER_PX)
    support = min(num / max(int(np.count_nonzero(visible)), 1), 1.0)
    sigma = np.inf  # largest of the centre and the radius
    if np.count_nonzero(near) > _CORRELATED_RAYS * 3:
        jacobian = np.ones((np.count_nonzero(near), 3))
        jacobian[:, :2] = unit(edges.places[near] - np.array([x, y]))
        variance = _CORRELATED_RAYS * float(np.mean(away[near] ** 2))
        covariance = variance * np.linalg.inv(jacobian.T @ jacobian + 1e-9 * np.eye(3))
        sigma = float(np.sqrt(np.diag(covariance).max()))
    return ImageCircle(float(x), float(y), radius, support, sigma), num


def _contrast(pictures: Sequence[np.ndarray], circle: np.ndarray) -> float:
    """Relative contrast of fine structure along a circle (3,), inside the pictures."""
    x, y, radius = circle
    angles = np.arange(0, 2 * np.pi, 1.0 / radius)
    across, down = x + radius * np.cos(angles), y + radius * np.sin(angles)
    inside = _inside(across, down, pictures[0].shape, _BORDER_PX)
    if not inside.any():
        return 0.0
    smooth = [cv2.GaussianBlur(picture, (0, 0), _TEXTURE_BLUR_PX) for picture in pictures]
    values = np.stack([_sampled(one, across[None], down[None])[0] for one in smooth])
    length = max(len(angles) // _TEXTURE_PARTS, 3)
    fine = values - cv2.blur(values, (length, 1), borderType=cv2.BORDER_REFLECT)
    relative = np.abs(fine) / (values + _DARK_OFFSET)
    return float(np.median(relative[:, inside]))  # flare is no scene


def _sampled(picture: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    places = (across - 0.5).astype(np.float32), (down - 0.5).astype(np.float32)
    nearest = cv2.BORDER_REPLICATE
    return cv2.remap(picture, *places, cv2.INTER_LINEAR, borderMode=nearest).astype(np.float64)


def _inside(
    across: np.ndarray, down: np.ndarray, shape: tuple[int, ...], border: float
) -> np.ndarray:
    """True where places lie in a picture (h, w), off its border by more than some pixels."""
    return np.logical_and.reduce(
        [across > border, across < shape[1] - border, down > border, down < shape[0] - border]
    )
