"""Robust losses on the squared, whitened residual, in GTSAM's scaling."""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np

from factors.compiled import kernel_and_part

_, _part = kernel_and_part(fastmath={"contract"})

LossKind = Literal["none", "huber", "cauchy", "geman_mcclure"]
_CODES: dict[str, int] = {"none": 0, "huber": 1, "cauchy": 2, "geman_mcclure": 3}


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """A loss and the whitened residual norm (sigmas) at which it departs from least squares."""

    kind: LossKind = "none"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in _CODES:
            raise ValueError(f"robust loss {self.kind!r} is none of {', '.join(_CODES)}")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale of the robust loss must be positive, not {self.scale}")

    @property
    def code(self) -> int:
        """The loss's code in the kernels."""
        return _CODES[self.kind]

    def noise_model(self, gaussian: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """GTSAM noise model with this loss around a Gaussian one."""
        estimators = gtsam.noiseModel.mEstimator
        if self.kind == "none":
            return gaussian
        make = {
            "huber": estimators.Huber,
            "cauchy": estimators.Cauchy,
            "geman_mcclure": estimators.GemanMcClure,
        }[self.kind]
        return gtsam.noiseModel.Robust.Create(make.Create(self.scale), gaussian)

    def rho(self, squared: np.ndarray) -> np.ndarray:
        """Loss (N,) of squared whitened residual norms (N,)."""
        c2, norm = self.scale**2, np.sqrt(squared)
        if self.kind == "huber":
            return np.where(squared > c2, self.scale * (norm - 0.5 * self.scale), 0.5 * squared)
        if self.kind == "cauchy":
            return 0.5 * c2 * np.log1p(squared / c2)
        if self.kind == "geman_mcclure":
            return 0.5 * squared * c2 / (c2 + squared)
        return 0.5 * squared

    def weights(self, squared: np.ndarray) -> np.ndarray:
        """Weights (N,) = 2 rho'(s) of squared whitened residual norms (N,)."""
        c2 = self.scale**2
        if self.kind == "huber":
            return np.sqrt(np.minimum(1.0, c2 / np.maximum(squared, 1e-300)))
        if self.kind == "none":
            return np.ones_like(squared, dtype=np.float64)
        weights = c2 / (c2 + squared)
        return weights if self.kind == "cauchy" else weights**2

    def curvatures(self, squared: np.ndarray) -> np.ndarray:
        """Second derivatives (N,) of the loss by a residual in the plane, the mean of those along
        it and across it: 2 rho'(s) + 2 s rho''(s). Weights alone are those across.
        """
        step = 1e-4  # of a squared residual
        weights = self.weights(squared)
        return weights + (self.weights(squared * (1 + step)) - weights) / step


@_part
def rho_and_weight(code, scale, squared):
    """Loss rho(s), near zero s / 2 as in GTSAM, and weight 2 rho'(s) of s = |residual|^2."""
    c2 = scale * scale
    if code == 1 and squared > c2:
        norm = np.sqrt(squared)
        return scale * (norm - 0.5 * scale), scale / norm
    if code == 2:
        return 0.5 * c2 * np.log1p(squared / c2), c2 / (c2 + squared)
    if code == 3:
        weight = c2 / (c2 + squared)
        return 0.5 * squared * weight, weight * weight
    return 0.5 * squared, 1.0
