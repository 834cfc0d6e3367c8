"""Panoramas of random waves on the sphere, right at edges and poles and with texture everywhere."""

from functools import cache

import numpy as np

from gsba.camera.sphere import erp_directions


def wave_panorama(width: int, seed: int = 0) -> np.ndarray:
    """Colours (width / 2, width, 3) uint8."""
    return _made_once(width, seed).copy()


@cache
def _made_once(width: int, seed: int) -> np.ndarray:
    rng, rays = np.random.default_rng(seed), erp_directions(width)
    waves = np.sin((rays @ rng.normal(0, 9, (3, 30)) + rng.uniform(0, 6, 30)).astype(np.float32))
    return np.clip(128 + 22 * waves @ rng.normal(0, 1, (30, 3)), 20, 255).astype(np.uint8)
