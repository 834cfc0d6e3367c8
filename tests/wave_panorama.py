"""Panoramas of random waves on the sphere, right at edges and poles and with texture everywhere."""

from functools import cache

import numpy as np

from gsba.camera.sphere import bearings_from_erp


def wave_panorama(width: int, seed: int = 0) -> np.ndarray:
    """Colours (width / 2, width, 3) uint8."""
    return _made_once(width, seed).copy()


@cache
def _made_once(width: int, seed: int) -> np.ndarray:
    rng, pixels = np.random.default_rng(seed), np.meshgrid(*map(np.arange, (width, width // 2)))
    rays = bearings_from_erp(np.stack(pixels, axis=-1) + 0.5, width, width // 2)
    waves = np.sin((rays @ rng.normal(0, 9, (3, 30)) + rng.uniform(0, 6, 30)).astype(np.float32))
    return np.clip(128 + 22 * waves @ rng.normal(0, 1, (30, 3)), 20, 255).astype(np.uint8)
