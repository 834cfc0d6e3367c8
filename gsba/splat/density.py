"""Adaptive density control: clone, split and prune Gaussians as in 3DGS."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import rotation_from_quaternion
from gsba.splat.adam import Moments
from gsba.splat.gaussians import Gaussians, concatenate

_DENSIFY_PULL = 2e-4  # gradient of a centre, focal lengths, from which a Gaussian becomes two


@dataclass(frozen=True, slots=True)
class Pull:
    """Accumulated gradients at projected centres since the last densification."""

    sums: np.ndarray  # (N,) float32, sums of gradient lengths, focal lengths
    counts: np.ndarray  # (N,) float32, views that rendered the Gaussian

    @classmethod
    def none(cls, num: int) -> "Pull":
        """Zero sums for Gaussians without any view."""
        return cls(np.zeros(num, np.float32), np.zeros(num, np.float32))

    def add(self, centres: np.ndarray, seen: np.ndarray, focal: float) -> None:
        """Add one view, in place: centres (N, 2) gradients per pixel, seen (N,) bool, Gaussians
        rendered in the view, and its focal length in pixels: half the width of a face."""
        self.sums[:] += focal * np.hypot(centres[:, 0], centres[:, 1])
        self.counts[:] += seen


def densify(
    gaussians: Gaussians,
    moments: Moments,
    pull: Pull,
    extent: float,
    most: int,
    prunes_huge: bool,
    rng: np.random.Generator,
) -> tuple[Gaussians, Moments, bool]:
    """Clone small and split large Gaussians with strong gradients, up to `most` and the strongest
    first, then prune faint and, if wanted, huge ones; thresholds are those of Kerbl et al., 2023,
    relative to the cameras' extent, map units. Returns them, their moments (zero for new ones), and
    True if the limit kept some out."""
    strength = pull.sums / np.maximum(pull.counts, 1)
    chosen = np.flatnonzero(strength >= _DENSIFY_PULL)
    room = max(most - len(gaussians), 0)
    capped = len(chosen) > room
    if capped:
        chosen = np.sort(chosen[np.argsort(-strength[chosen], kind="stable")[:room]])
    small = np.exp(gaussians.log_scales[chosen].max(axis=1)) <= 0.01 * extent
    halves = gaussians.select(np.repeat(chosen[~small], 2))
    scales = np.exp(halves.log_scales)
    within = scales * rng.standard_normal(scales.shape, dtype=np.float32)
    unit = halves.quaternions / np.linalg.norm(halves.quaternions, axis=1, keepdims=True)
    shifts = np.einsum("nij,nj->ni", rotation_from_quaternion(unit), within)
    halves = replace(
        halves,
        means=halves.means + shifts.astype(np.float32),
        log_scales=halves.log_scales - np.float32(np.log(1.6)),  # a half is smaller by this factor
    )
    kept = np.ones(len(gaussians), bool)
    kept[chosen[~small]] = False
    new = concatenate([gaussians.select(chosen[small]), halves])
    gaussians = concatenate([gaussians.select(kept), new])
    moments = moments.select(kept).extended(new)
    stays = 1 / (1 + np.exp(-gaussians.opacity_logits)) >= 5e-3
    if prunes_huge:
        stays &= np.exp(gaussians.log_scales.max(axis=1)) <= 0.1 * extent
    if not stays.any():  # an empty splat could never recover
        return gaussians, moments, capped
    return gaussians.select(stays), moments.select(stays), capped


def reset_opacity(gaussians: Gaussians, moments: Moments) -> tuple[Gaussians, Moments]:
    """Make every Gaussian almost transparent, so that only necessary ones regain opacity."""
    highest = np.float32(np.log(0.01 / (1 - 0.01)))
    logits = np.minimum(gaussians.opacity_logits, highest)
    first, second = (
        replace(part, opacity_logits=np.zeros_like(logits))
        for part in (moments.first, moments.second)
    )
    return replace(gaussians, opacity_logits=logits), Moments(first, second)
