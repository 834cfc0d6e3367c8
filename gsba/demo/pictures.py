"""Procedural pictures for the walls: abstract paintings and lettered posters, framed."""

from collections.abc import Callable

import cv2
import numpy as np

from gsba.demo.textures import noise

_PALETTES = (
    ((226, 190, 92), (196, 64, 48), (44, 70, 112), (238, 226, 204), (30, 30, 34)),
    ((58, 104, 98), (218, 140, 74), (244, 232, 208), (112, 48, 56), (34, 42, 54)),
    ((108, 152, 190), (232, 214, 166), (188, 88, 84), (52, 60, 44), (246, 240, 230)),
    ((40, 44, 60), (200, 176, 140), (150, 52, 44), (92, 120, 84), (232, 222, 210)),
)
_WORDS = ("LIGHT", "FORM", "ECHO", "DRIFT", "LOOP", "FIELD", "STONE", "RIVER", "NORTH", "ATLAS")

Palette = np.ndarray  # (5, 3) float64, RGB


def _pick(rng: np.random.Generator, palette: Palette) -> list[float]:
    return np.clip(palette[rng.integers(len(palette))] * rng.uniform(0.8, 1.1), 0, 255).tolist()


def _discs(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> None:
    height, width = image.shape[:2]
    for radius in np.exp(rng.uniform(np.log(4), np.log(0.3 * height), 70))[::-1]:
        center = (int(rng.uniform(0, width)), int(rng.uniform(0, height)))
        fill = -1 if rng.random() < 0.65 else int(rng.integers(2, 6))
        cv2.circle(image, center, int(radius), _pick(rng, palette), fill, cv2.LINE_AA)


def _blocks(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> None:
    """Draw recursively divided rectangles with black outlines."""

    def cut(x0: int, y0: int, x1: int, y1: int, depth: int) -> None:
        w, h = x1 - x0, y1 - y0
        if depth and max(w, h) > 24:
            if w * rng.uniform(0.7, 1.4) > h:
                x = int(x0 + w * rng.uniform(0.3, 0.7))
                cut(x0, y0, x, y1, depth - 1)
                cut(x, y0, x1, y1, depth - 1)
            else:
                y = int(y0 + h * rng.uniform(0.3, 0.7))
                cut(x0, y0, x1, y, depth - 1)
                cut(x0, y, x1, y1, depth - 1)
            return
        cv2.rectangle(image, (x0, y0), (x1, y1), _pick(rng, palette), -1)
        cv2.rectangle(image, (x0, y0), (x1, y1), (24, 24, 26), 2)

    cut(0, 0, image.shape[1], image.shape[0], 6)


def _strokes(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> None:
    height, width = image.shape[:2]
    for _ in range(130):
        n = 12
        path = rng.uniform(0, [width, height]) + np.cumsum(rng.normal(0, 9, (n, 2)), axis=0)
        points = np.round(path * 16).astype(np.int32)[:, None]
        thickness = int(np.exp(rng.uniform(0, 2.4)))
        cv2.polylines(image, [points], False, _pick(rng, palette), thickness, cv2.LINE_AA, 4)


def _landscape(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> None:
    """Draw layered ridges with scattered trees and a sun."""
    height, width = image.shape[:2]
    sun = (int(rng.uniform(0.2, 0.8) * width), int(0.25 * height))
    cv2.circle(image, sun, height // 9, (246, 226, 150), -1, cv2.LINE_AA)
    for layer in np.linspace(0.35, 0.9, 6):
        ridge = layer * height + 0.06 * height * noise(rng, 1, width, 128)[0]
        tone = np.asarray(_pick(rng, palette)) * (1.1 - 0.6 * layer)
        skyline = np.r_[np.arange(width), width, 0], np.r_[ridge, height, height]
        outline = np.stack(skyline, axis=1)
        cv2.fillPoly(image, [np.round(outline).astype(np.int32)[:, None]], tone.tolist())
        for at in rng.integers(0, width, 24):
            size = rng.uniform(2, 14) * (0.4 + layer)
            x, y = [at - size / 3, at, at + size / 3], [ridge[at], ridge[at] - size, ridge[at]]
            dark = (tone * rng.uniform(0.3, 0.7)).tolist()
            cv2.fillPoly(
                image,
                [np.round(np.stack([x, y], axis=1)).astype(np.int32)[:, None]],
                dark,
                cv2.LINE_AA,
            )


def _poster(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> None:
    height = image.shape[0]
    image[:] = palette[int(np.argmax(palette.sum(axis=1)))]
    ink = palette[int(np.argmin(palette.sum(axis=1)))].tolist()
    y = 0.0
    while y < height:
        size = float(rng.choice([0.35, 0.5, 0.8, 1.5], p=[0.4, 0.3, 0.2, 0.1]))
        y += 26 * size + 3
        text = " ".join(rng.choice(_WORDS, 8)) + f" {rng.integers(1900, 2030)}"
        color = ink if rng.random() < 0.7 else _pick(rng, palette)
        at = (int(rng.uniform(4, 14)), int(y))
        weight = 2 if size > 0.7 else 1
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_DUPLEX, size, color, weight, cv2.LINE_AA)


_STYLES: tuple[Callable[[np.random.Generator, np.ndarray, Palette], None], ...] = (
    _discs,
    _landscape,
    _blocks,
    _poster,
    _strokes,
)


def picture(rng: np.random.Generator, height: int, width: int, style: int) -> np.ndarray:
    """Framed picture, (height, width, 3) uint8 RGB.

    Args:
        height, width: pixels.
        style: any integer, modulo the number of styles; contents are random.
    """
    palette = np.array(_PALETTES[rng.integers(len(_PALETTES))], dtype=np.float64)
    frame, mat = 7, int(rng.choice([0, 12]))
    inner = np.empty((height - 2 * (frame + mat), width - 2 * (frame + mat), 3), np.uint8)
    inner[:] = _pick(rng, palette)
    _STYLES[style % len(_STYLES)](rng, inner, palette)
    canvas = inner * (1 + 0.05 * noise(rng, *inner.shape[:2], 32)[..., None])
    wood = rng.choice([[58, 42, 32], [168, 132, 74], [36, 36, 38], [120, 82, 52]])
    image = np.full((height, width, 3), wood, np.float32)
    image[frame:-frame, frame:-frame] = (226, 220, 206)
    edge = frame + mat
    image[edge:-edge, edge:-edge] = canvas
    return np.clip(image, 0, 255).astype(np.uint8)
