"""The compiled plane sweep against the same in NumPy."""

import cv2
import numpy as np

from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.geometry import pose
from gsba.masks import _distractor_kernels

HEIGHT, WIDTH, NUM, CAP = 24, 48, 5, 60.0


def _bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours (..., C) of a panorama at pixels (..., 2); NaN where a negative one takes part."""
    height, width = image.shape[:2]
    corner = np.floor(uv - 0.5).astype(int)
    part = uv - 0.5 - corner
    out = np.zeros((*uv.shape[:-1], image.shape[2]))
    for right in (0, 1):
        for below in (0, 1):
            row = np.clip(corner[..., 1] + below, 0, height - 1)
            color = image[row, (corner[..., 0] + right) % width].astype(float)
            color[color[..., 0] < 0] = np.nan
            weight = np.abs(1 - right - part[..., 0]) * np.abs(1 - below - part[..., 1])
            out += weight[..., None] * color
    return out


def test_comparison_is_that_of_numpy() -> None:
    draw = np.random.default_rng(2)
    own = cv2.GaussianBlur(draw.uniform(0, 255, (HEIGHT, WIDTH, 3)).astype(np.float32), (9, 9), 3)
    others = np.stack([own + draw.normal(0, 4, own.shape).astype(np.float32) for _ in range(NUM)])
    others[1, 5:15, 40:] = others[1, 5:15, :6] = -1.0  # over the seam
    others[:, 16:21, 20:32] = -1.0  # nobody sees the middle of this
    others[:4, 4:10, 20:32] = -1.0
    least, most = own - 3, own + 3
    rotations = [cv2.Rodrigues(draw.normal(0, 0.1, 3))[0] for _ in range(NUM)]
    n_T_own = np.stack([pose(R, draw.normal(0, 0.2, 3)) for R in rotations]).astype(np.float32)
    rays = erp_directions(WIDTH)
    inverse = draw.uniform(0.1, 0.9, (HEIGHT, WIDTH)).astype(np.float32)

    differences = np.empty((NUM, HEIGHT, WIDTH), np.float32)
    away, spread = np.empty((HEIGHT, WIDTH), np.float32), np.empty((HEIGHT, WIDTH), np.float32)
    _distractor_kernels.compare(
        own, least, most, others, n_T_own, rays.astype(np.float32), inverse, np.float32(CAP),
        differences, away, spread,
    )  # fmt: skip

    seen = np.einsum("nij,hwj->nhwi", n_T_own[:, :3, :3], rays)
    seen += inverse[None, ..., None] * n_T_own[:, None, None, :3, 3]
    uv = erp_from_bearings(seen, WIDTH, HEIGHT)
    levels = np.stack([_bilinear(others[m], uv[m]) for m in range(NUM)])
    beyond = np.maximum(np.maximum(least - levels, levels - most), 0).mean(axis=-1)
    masked = np.isnan(beyond)
    assert masked.all(axis=0).any() and masked.mean() < 0.3
    tolerance = 0.3  # grey levels over 1e-3 rad
    # Within that of a pixel that is masked, either answer is right.
    aside = [1e-3 * HEIGHT / np.pi * np.array(way) for way in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    near = np.stack([[_bilinear(others[m], uv[m] + by) for m in range(NUM)] for by in aside])
    sure = np.all(np.isnan(near[..., 0]) == masked, axis=0)
    assert sure.mean() > 0.99
    expected = np.where(masked, CAP, np.minimum(beyond, CAP))
    np.testing.assert_allclose(differences[sure], expected[sure], atol=tolerance)
    sure = sure.all(axis=0)
    greys = np.ma.masked_invalid(levels.mean(axis=-1))
    median = np.ma.median(greys, axis=0)
    off = np.minimum(np.abs(own.mean(axis=-1) - median), CAP).filled(0)
    np.testing.assert_allclose(away[sure], off[sure], atol=tolerance)
    ordered = np.sort(np.minimum(np.abs(greys - median), CAP).filled(np.inf), axis=0)
    half = (~masked).sum(axis=0) // 2
    typical = np.take_along_axis(ordered, half[None], axis=0)[0]
    typical = np.where(np.isinf(typical), CAP, typical)
    np.testing.assert_allclose(spread[sure], typical[sure], atol=tolerance)


def test_best_distances_are_kept() -> None:
    draw = np.random.default_rng(3)
    shape = (HEIGHT, WIDTH)
    best = np.full((2, *shape), CAP, np.float32)
    away_best, spread_best = np.zeros(shape, np.float32), np.full(shape, 2 * CAP, np.float32)
    steps = draw.uniform(0, CAP, (4, NUM, *shape)).astype(np.float32)
    away, spread = draw.uniform(0, CAP, (2, 4, *shape)).astype(np.float32)
    for step in range(4):
        _distractor_kernels.keep_best(
            steps[step], away[step], spread[step], best, away_best, spread_best
        )
    ordered = np.sort(steps, axis=1).min(axis=0)
    np.testing.assert_array_equal(best, ordered[1:3])
    np.testing.assert_array_equal(spread_best, spread.min(axis=0))
    which = spread.argmin(axis=0)[None]
    np.testing.assert_array_equal(away_best, np.take_along_axis(away, which, axis=0)[0])
