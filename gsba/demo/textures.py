"""Procedural albedo textures, aperiodic and detailed at every scale. All (H, W, 3) uint8 RGB."""

import cv2
import numpy as np

Color = tuple[float, float, float]


def noise(rng: np.random.Generator, height: int, width: int, coarsest: float = 256) -> np.ndarray:
    """Multi-octave value noise, (height, width) float32, mean 0, standard deviation 1. `coarsest`:
    cell size of the first octave in pixels; halved down to two pixels."""
    out = np.zeros((height, width), np.float32)
    cell, weight = float(coarsest), 1.0
    while cell >= 2:
        shape = int(np.ceil(height / cell)) + 3, int(np.ceil(width / cell)) + 3
        lattice = rng.standard_normal(shape, dtype=np.float32)
        size = int(shape[1] * cell), int(shape[0] * cell)
        grown = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
        out += weight * grown[int(cell) :, int(cell) :][:height, :width]
        cell, weight = cell / 2, weight * 0.72
    return (out - out.mean()) / (out.std() + 1e-6)


def _tinted(field: np.ndarray, color: Color, amount: float) -> np.ndarray:
    """Colour (3) times (1 + amount * field), (H, W, 3) float32."""
    return np.asarray(color, np.float32) * (1 + amount * field[..., None])


def _to_uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(image + 0.5, 0, 255).astype(np.uint8)


def _polygon(rng: np.random.Generator, center: np.ndarray, radius: float) -> np.ndarray:
    """Irregular polygon, (n, 1, 2) int32 in 1/16 pixel for cv2's shift=4."""
    n = int(rng.integers(4, 8))
    angles = np.sort(rng.uniform(0, 2 * np.pi, n))
    radii = radius * rng.uniform(0.55, 1.0, n)
    points = center + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.round(points * 16).astype(np.int32)[:, None]


def terrazzo(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Stone chips of many sizes in a light cement."""
    image = _to_uint8(_tinted(noise(rng, height, width, 128), (188, 182, 170), 0.05))
    palette = np.array(
        [
            [74, 70, 68],
            [142, 92, 66],
            [222, 214, 200],
            [108, 120, 116],
            [178, 142, 96],
            [60, 78, 92],
        ]
    )
    count = height * width // 130
    centers = rng.uniform(0, [width, height], (count, 2))
    radii = np.exp(rng.uniform(np.log(1.8), np.log(11), count))
    for center, radius in zip(centers, radii, strict=True):
        color = palette[rng.integers(len(palette))] * rng.uniform(0.8, 1.15)
        cv2.fillPoly(image, [_polygon(rng, center, radius)], color.tolist(), cv2.LINE_AA, 4)
    return _to_uint8(image * (1 + 0.03 * noise(rng, height, width, 512)[..., None]))


def plaster(rng: np.random.Generator, height: int, width: int, color: Color) -> np.ndarray:
    """Trowelled wall: cloudy tone, strokes and small blemishes."""
    image = _to_uint8(_tinted(noise(rng, height, width, 256), color, 0.06))
    for _ in range(height * width // 2500):
        start = rng.uniform(0, [width, height])
        end = start + rng.normal(0, 22, 2)
        tone = np.asarray(color) * rng.uniform(0.74, 1.16)
        p, q = (tuple(np.round(x * 16).astype(int).tolist()) for x in (start, end))
        cv2.line(image, p, q, tone.tolist(), int(rng.integers(1, 3)), cv2.LINE_AA, 4)
    for _ in range(height * width // 3500):
        center, radius = rng.uniform(0, [width, height]), np.exp(rng.uniform(0, 1.8))
        tone = np.asarray(color) * rng.uniform(0.55, 0.95)
        cv2.fillPoly(image, [_polygon(rng, center, radius)], tone.tolist(), cv2.LINE_AA, 4)
    return _to_uint8(image * (1 + 0.04 * noise(rng, height, width, 16)[..., None]))


def brick(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Bricks of random sizes and colours in slightly uneven courses."""
    image = _to_uint8(_tinted(noise(rng, height, width, 32), (176, 166, 152), 0.08))
    y = 0.0
    while y < height:
        course = rng.uniform(12, 15)
        x = -rng.uniform(0, 40)
        while x < width:
            length = rng.uniform(24, 44)
            tone = np.array([150, 78, 56]) * rng.uniform(0.55, 1.3) + rng.normal(0, 9, 3)
            box = np.array([[x, y], [x + length, y], [x + length, y + course], [x, y + course]])
            box += rng.normal(0, 0.7, (4, 2)) + np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
            points = np.round(box * 16).astype(np.int32)[:, None]
            cv2.fillPoly(image, [points], np.clip(tone, 20, 235).tolist(), cv2.LINE_AA, 4)
            x += length + 1
        y += course + 1
    return _to_uint8(image * (1 + 0.10 * noise(rng, height, width, 64)[..., None]))


def wood(rng: np.random.Generator, height: int, width: int, color: Color) -> np.ndarray:
    """Boards along the width with grain and knots."""
    image = np.empty((height, width, 3), np.uint8)
    y = 0
    while y < height:
        board = min(int(rng.integers(16, 34)), height - y)
        grain = cv2.resize(
            noise(rng, board * 2, width // 6 + 8, 16)[:board], (width, board), interpolation=1
        )
        image[y : y + board] = _to_uint8(_tinted(grain, color, 0.13) * rng.uniform(0.72, 1.2))
        for x in np.cumsum(rng.uniform(60, 260, width // 60)):
            center = (int(x), int(y + rng.uniform(0.2, 0.8) * board))
            axes = (int(rng.integers(2, 7)), int(rng.integers(1, 5)))
            tone = np.asarray(color) * rng.uniform(0.3, 0.6)
            cv2.ellipse(image, center, axes, rng.uniform(-20, 20), 0, 360, tone.tolist(), -1, 16)
        image[y] //= 2
        y += board
    return image


def mosaic(rng: np.random.Generator, height: int, width: int, color: Color) -> np.ndarray:
    """Irregular glazed tiles: cells of scattered points, one tone each, dark joints."""
    step = 13
    gx, gy = np.meshgrid(np.arange(0, width + step, step), np.arange(0, height + step, step))
    sites = np.stack([gx, gy], axis=-1) + rng.uniform(-6, 6, (*gx.shape, 2))
    tones = np.asarray(color) * rng.uniform(0.4, 1.35, (*gx.shape, 1))
    tones = tones + rng.normal(0, 16, (*gx.shape, 3))
    image = np.full((height, width, 3), 58, np.uint8)
    for site, tone in zip(sites.reshape(-1, 2), tones.reshape(-1, 3), strict=True):
        shape = [_polygon(rng, site, 8.5)]
        cv2.fillPoly(image, shape, np.clip(tone, 12, 245).tolist(), cv2.LINE_AA, 4)
    return _to_uint8(image * (1 + 0.05 * noise(rng, height, width, 32)[..., None]))


def books(rng: np.random.Generator, height: int, width: int, shelves: int) -> np.ndarray:
    """A bookcase seen from the front: shelves of upright books with titles."""
    image = np.full((height, width, 3), (44, 34, 28), np.uint8)
    row = height / shelves
    for shelf in range(shelves):
        floor = (shelf + 1) * row - 5
        cv2.rectangle(image, (0, int(floor)), (width, int(floor + 4)), (104, 74, 48), -1)
        x = rng.uniform(3, 9)
        while x < width - 8:
            thick, tall = rng.uniform(5, 15), row * rng.uniform(0.5, 0.86)
            top = int(floor - tall)
            tone = rng.uniform(25, 225, 3) * rng.uniform(0.5, 1.0)
            cv2.rectangle(image, (int(x), top), (int(x + thick - 1), int(floor)), tone.tolist(), -1)
            for _ in range(int(rng.integers(1, 5))):
                band = int(top + rng.uniform(0.08, 0.9) * tall)
                mark = rng.uniform(60, 255, 3).tolist()
                end = (int(x + thick - 2), band + int(rng.integers(0, 5)))
                cv2.rectangle(image, (int(x + 1), band), end, mark, -1)
            x += thick + (rng.uniform(0, 18) if rng.random() < 0.1 else 0)
    return _to_uint8(image * (1 + 0.06 * noise(rng, height, width, 64)[..., None]))


def rug(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Woven rug: nested borders, scattered motifs."""
    image = np.full((height, width, 3), (120, 44, 40), np.uint8)
    for inset, tone in ((8, (38, 52, 82)), (20, (196, 168, 116)), (25, (108, 40, 38))):
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), tone, -1)
    for _ in range(height * width // 300):
        center = rng.uniform([30, 30], [width - 30, height - 30])
        tone = np.array([[206, 176, 118], [40, 60, 92], [166, 84, 50], [70, 88, 62]])
        shape = [_polygon(rng, center, float(rng.uniform(3, 15)))]
        cv2.fillPoly(image, shape, tone[rng.integers(4)].tolist(), cv2.LINE_AA, 4)
    return _to_uint8(image * (1 + 0.10 * noise(rng, height, width, 8)[..., None]))
