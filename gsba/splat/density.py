"""Adaptive density control: clone, split and prune Gaussians as in 3DGS."""

from dataclasses import dataclass, replace

import numpy as np

from gsba.geometry import rotation_from_quaternion
from gsba.splat.adam import Moments
from gsba.splat.gaussians import Gaussians, concatenate

SPLIT_SHRINK = 1.6  # factor by which a split Gaussian's halves are smaller
RESET_OPACITY = 0.01


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


@dataclass(frozen=True, slots=True)
class DensityLimits:
    """Thresholds of the density control."""

    pull: float  # mean gradient from which a Gaussian is densified, focal lengths
    clone_scale: float  # map units, smaller Gaussians are cloned, larger ones split
    max_scale: float | None  # map units, larger Gaussians are pruned; None = no limit
    min_opacity: float  # fainter Gaussians are pruned
    max_gaussians: int  # limit; the strongest gradients are densified first


def densify(
    gaussians: Gaussians,
    moments: Moments,
    pull: Pull,
    limits: DensityLimits,
    rng: np.random.Generator,
) -> tuple[Gaussians, Moments, bool]:
    """Clone small and split large Gaussians with strong gradients, then prune. Returns them, their
    moments (zero for new ones), and True if the limit kept some out."""
    strength = pull.sums / np.maximum(pull.counts, 1)
    chosen = np.flatnonzero(strength >= limits.pull)
    room = max(limits.max_gaussians - len(gaussians), 0)
    capped = len(chosen) > room
    if capped:
        chosen = np.sort(chosen[np.argsort(-strength[chosen], kind="stable")[:room]])
    small = np.exp(gaussians.log_scales[chosen].max(axis=1)) <= limits.clone_scale
    halves = gaussians.select(np.repeat(chosen[~small], 2))
    scales = np.exp(halves.log_scales)
    within = scales * rng.standard_normal(scales.shape, dtype=np.float32)
    unit = halves.quaternions / np.linalg.norm(halves.quaternions, axis=1, keepdims=True)
    shifts = np.einsum("nij,nj->ni", rotation_from_quaternion(unit), within)
    halves = replace(
        halves,
        means=halves.means + shifts.astype(np.float32),
        log_scales=halves.log_scales - np.float32(np.log(SPLIT_SHRINK)),
    )
    kept = np.ones(len(gaussians), bool)
    kept[chosen[~small]] = False
    new = concatenate([gaussians.select(chosen[small]), halves])
    gaussians = concatenate([gaussians.select(kept), new])
    moments = moments.select(kept).extended(new)
    stays = 1 / (1 + np.exp(-gaussians.opacity_logits)) >= limits.min_opacity
    if limits.max_scale is not None:
        stays &= np.exp(gaussians.log_scales.max(axis=1)) <= limits.max_scale
    if not stays.any():  # an empty splat could never recover
        return gaussians, moments, capped
    return gaussians.select(stays), moments.select(stays), capped


def reset_opacity(gaussians: Gaussians, moments: Moments) -> tuple[Gaussians, Moments]:
    """Make every Gaussian almost transparent, so that only necessary ones regain opacity."""
    highest = np.float32(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    logits = np.minimum(gaussians.opacity_logits, highest)
    return replace(gaussians, opacity_logits=logits), moments.without_opacity()
