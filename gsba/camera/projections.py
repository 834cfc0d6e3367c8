"""Projections: how lenses map directions to pixels in the lens's own axes (x right, y down, z
ahead), with Jacobians."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from typing import ClassVar, Self

import numpy as np

from gsba.geometry import unit

_NUM_NEWTON_STEPS = 8  # enough for angles to converge in double precision
_MIN_SLOPE = 0.1  # of the radius by the angle, in Newton's steps beyond a polynomial's own range


@dataclass(frozen=True, slots=True)
class RadialProjection(ABC):
    """Map of one lens from directions in its frame to pixels (u, v), from the picture's corner,
    symmetric about the axis: r pixels from the principal point at each angle.

    Its parameters are the relative focal length (a factor's logarithm), the principal point in
    units of the focal length, and the radial terms.
    """

    width: int  # pixels
    height: int  # pixels
    focal: float  # pixels per radian on the axis
    principal: tuple[float, float]  # pixels, corner origin
    radial: tuple[float, ...] = ()  # terms of the formula

    max_angle: ClassVar[float] = np.pi  # rad from the axis: nothing is seen from there on

    @abstractmethod
    def radii(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance from the principal point in focal lengths at angles (rad) from the axis, and its
        derivative by the angle."""

    def by_radial(self, angles: np.ndarray) -> np.ndarray:
        """Derivatives (N, len(radial)) of `radii` by the radial terms at angles (N,)."""
        return np.zeros((len(angles), 0))

    @property
    def num_parameters(self) -> int:
        """K, parameters that can be estimated, in the order of `jacobians` and `stepped`."""
        return 3 + len(self.radial)

    def project(self, directions: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of vectors (..., 3) of any length; NaN where the lens cannot see."""
        across = np.hypot(directions[..., 0], directions[..., 1])
        angles = np.arctan2(across, directions[..., 2])
        if self.max_angle < np.pi:
            angles = np.where(angles < self.max_angle, angles, np.nan)
        radii = self.focal * self.radii(angles)[0]
        away = directions[..., :2] / np.maximum(across, 1e-300)[..., None]
        return np.asarray(self.principal) + radii[..., None] * away

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of pixels (..., 2)."""
        away = (pixels - np.asarray(self.principal)) / self.focal
        radii = np.hypot(away[..., 0], away[..., 1])
        angles, most = radii.copy(), self.max_angle
        for _ in range(_NUM_NEWTON_STEPS):
            reached, slope = self.radii(angles)
            angles = np.clip(angles - (reached - radii) / np.maximum(slope, _MIN_SLOPE), 0, most)
        across = (np.sin(angles) / np.maximum(radii, 1e-300))[..., None] * away
        return np.concatenate([across, np.cos(angles)[..., None]], axis=-1)

    def jacobians(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Jacobians (N, 2, 3) of pixels by vectors (N, 3), and (N, 2, K) by the parameters."""
        x, y, z = directions.T
        across, squares = np.hypot(x, y), np.sum(directions**2, axis=1)
        angles = np.arctan2(across, z)
        reached, slope = self.radii(angles)
        near = across <= 1e-9 * np.sqrt(squares)  # sine
        safe = np.where(near, 1.0, across)
        away = np.where(near[:, None], [1.0, 0.0], directions[:, :2] / safe[:, None])
        stretch = np.where(near, slope / np.where(near, z, 1.0), reached / safe)
        out = np.zeros((len(directions), 2, 3))
        outer = np.einsum("ni,nj->nij", away, away)
        out[:, :, :2] = (slope * z / squares - stretch)[:, None, None] * outer
        out[:, [0, 1], [0, 1]] += stretch[:, None]
        out[:, :, 2] = -(slope * across / squares)[:, None] * away
        along = np.concatenate([reached[:, None], self.by_radial(angles)], axis=1)
        along = away[:, :, None] * along[:, None]
        ones = np.broadcast_to(np.eye(2), (len(directions), 2, 2))
        by_parameters = np.concatenate([along[:, :, :1], ones, along[:, :, 1:]], axis=2)
        return self.focal * out, self.focal * by_parameters

    def stepped(self, step: np.ndarray) -> Self:
        """The projection after a step (K,) of its parameters."""
        x, y = np.asarray(self.principal) + self.focal * step[1:3]
        terms = np.asarray(self.radial) + step[3:]
        return replace(
            self,
            focal=float(self.focal * np.exp(step[0])),
            principal=(float(x), float(y)),
            radial=tuple(float(term) for term in terms),
        )

    def step_from(self, before: Self) -> np.ndarray:
        """The step (K,) by which `stepped` turns the projection `before` into this one."""
        away = (np.asarray(self.principal) - before.principal) / before.focal
        bent = np.asarray(self.radial) - np.asarray(before.radial)
        return np.array([np.log(self.focal / before.focal), *away, *bent])


@dataclass(frozen=True, slots=True)
class FisheyeProjection(RadialProjection):
    """r = f (th + k1 th^3 + k2 th^5 + k3 th^7 + k4 th^9) (Kannala and Brandt, PAMI 2006); without
    radial terms it is the equidistant lens."""

    def radii(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `RadialProjection`."""
        return _odd_polynomial(angles, self.radial)

    def by_radial(self, angles: np.ndarray) -> np.ndarray:
        """See `RadialProjection`."""
        return angles[:, None] ** np.arange(3, 3 + 2 * len(self.radial), 2)


@dataclass(frozen=True, slots=True)
class PerspectiveProjection(RadialProjection):
    """r = f (t + k1 t^3 + k2 t^5), t = tan th (Brown, Photogrammetric Engineering 1966)."""

    max_angle: ClassVar[float] = np.pi / 2 - 1e-6

    def radii(self, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `RadialProjection`."""
        tangents = np.tan(angles)
        reached, slope = _odd_polynomial(tangents, self.radial)
        return reached, slope * (1 + tangents**2)

    def by_radial(self, angles: np.ndarray) -> np.ndarray:
        """See `RadialProjection`."""
        return np.tan(angles)[:, None] ** np.arange(3, 3 + 2 * len(self.radial), 2)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """See `RadialProjection`; Newton's steps are taken in the tangent, which is nearly linear.
        Pixels that no direction reaches get one anyway, never NaN."""
        away = (pixels - np.asarray(self.principal)) / self.focal
        radii = np.hypot(away[..., 0], away[..., 1])
        tangents = radii.copy()
        for _ in range(_NUM_NEWTON_STEPS):
            reached, slope = _odd_polynomial(tangents, self.radial)
            tangents = tangents - (reached - radii) / np.maximum(slope, _MIN_SLOPE)
            tangents = np.clip(tangents, 0, np.tan(self.max_angle))
        scale = np.divide(tangents, radii, out=np.ones_like(radii), where=radii > 0)
        rays = np.concatenate([scale[..., None] * away, np.ones_like(radii)[..., None]], axis=-1)
        return unit(rays)


PROJECTIONS: dict[str, Callable[..., RadialProjection]] = {  # by "model" in calibration files
    "kannala-brandt": FisheyeProjection,
    "perspective": PerspectiveProjection,
}


def projection_of_model(model: object) -> Callable[..., RadialProjection]:
    """The projection that a calibration file names; what follows a colon explains it.

    Packages add projections by the entry point group `gsba.projections`.

    Raises:
        ValueError: no such projection is known.
    """
    name = str(model).split(":")[0].strip().lower()
    if name in PROJECTIONS:
        return PROJECTIONS[name]
    others = {entry.name: entry for entry in entry_points(group="gsba.projections")}
    if name not in others:
        known = ", ".join((*PROJECTIONS, *others))
        raise ValueError(f"its model is '{name:.40}', which is none of {known}")
    return others[name].load()


def _odd_polynomial(x: np.ndarray, terms: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """x + terms[0] x^3 + terms[1] x^5 + ..., and its derivative."""
    squares = x * x
    value, slope = np.zeros_like(x), np.zeros_like(x)
    powers = range(2 * len(terms) + 1, 0, -2)
    for power, k in zip(powers, (*terms[::-1], 1.0), strict=True):
        value, slope = value * squares + k, slope * squares + power * k
    return value * x, slope
