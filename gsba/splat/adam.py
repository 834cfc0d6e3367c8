"""Adam on the parameters of a splat (Kingma and Ba, 2015), a learning rate for each group."""

from dataclasses import dataclass, fields

import numpy as np

from factors.compiled import kernel_and_part
from gsba.splat.gaussians import Gaussians, concatenate, zeros_like

_kernel, _ = kernel_and_part(fastmath={"contract"})
BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


@dataclass(frozen=True, slots=True)
class LearningRates:
    """Learning rates of a step."""

    means: float  # map units
    log_scales: float
    quaternions: float
    opacity_logits: float
    sh: float  # of the constant harmonic
    sh_rest: float  # of the other harmonics


@dataclass(frozen=True, slots=True)
class Moments:
    """Running means of the gradients and of their squares."""

    first: Gaussians
    second: Gaussians

    @classmethod
    def zero(cls, gaussians: Gaussians) -> "Moments":
        """Zero moments of Gaussians before the first step."""
        return cls(zeros_like(gaussians), zeros_like(gaussians))

    def select(self, rows: np.ndarray) -> "Moments":
        """The moments of some Gaussians."""
        return Moments(self.first.select(rows), self.second.select(rows))

    def extended(self, new: Gaussians) -> "Moments":
        """The moments with zeros appended for new Gaussians."""
        zeros = zeros_like(new)
        return Moments(concatenate([self.first, zeros]), concatenate([self.second, zeros]))


def step(
    gaussians: Gaussians, gradients: Gaussians, moments: Moments, rates: LearningRates, count: int
) -> None:
    """Move all parameters in place by one step, the count-th from 1; moments change, too."""
    correction1, correction2 = 1 - BETA1**count, np.sqrt(1 - BETA2**count)
    for entry in fields(Gaussians):
        rate = getattr(rates, entry.name)
        rest = rates.sh_rest if entry.name == "sh" else rate
        values, slopes, first, second = (
            getattr(part, entry.name).reshape(len(gaussians), -1)
            for part in (gaussians, gradients, moments.first, moments.second)
        )
        num_first = 3 if entry.name == "sh" else values.shape[1]
        scales = np.full(values.shape[1], rest / correction1, np.float32)
        scales[:num_first] = rate / correction1
        _move(values, slopes, first, second, scales, np.float32(correction2))


@_kernel
def _move(values, slopes, first, second, rates, correction2):
    keep1, keep2 = np.float32(BETA1), np.float32(BETA2)
    new1, new2, eps = np.float32(1 - BETA1), np.float32(1 - BETA2), np.float32(EPS)
    for g in range(values.shape[0]):
        for k in range(values.shape[1]):
            slope = slopes[g, k]
            m = keep1 * first[g, k] + new1 * slope
            v = keep2 * second[g, k] + new2 * slope * slope
            first[g, k], second[g, k] = m, v
            values[g, k] -= rates[k] * m / (np.sqrt(v) / correction2 + eps)
