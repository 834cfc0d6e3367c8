"""Image circles on drawn fisheye pictures and on real captures."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsba.frames.image_circles import find_circle
from gsba.frames.side_by_side import recognise

REAL = Path(__file__).parents[3] / "shared/data/real"


@dataclass(frozen=True)
class Drawn:
    """A lens's picture as drawn."""

    width: int
    height: int
    x: float
    y: float
    radius: float
    glow: float  # grey value of the housing beside the rim
    glow_end: float  # radii at which it ends
    sharp_end: bool  # whether it ends at once; else it fades
    flare: bool
    dark_share: float  # part of the rim that is in shadow
    dim: float  # brightness of the scene, 1 = full


def _draw(rng: np.random.Generator) -> Drawn:
    """A picture of a random lens: off its centre, glowing, in shadow, cut off left and right."""
    height = int(rng.integers(240, 480))
    width = int(height * rng.choice([1.0, 1.0, 1.03, 0.94]))
    side, dim = min(width, height), rng.choice([1.0, rng.uniform(0.35, 1.0)])
    return Drawn(
        width,
        height,
        width / 2 + 0.04 * side * rng.uniform(-1, 1),
        height / 2 + 0.04 * side * rng.uniform(-1, 1),
        side * rng.uniform(0.38, 0.56),
        dim * rng.choice([0.0, rng.uniform(20, 80)]),  # it is of the same light
        rng.uniform(1.08, 1.15),
        bool(rng.integers(2)),
        bool(rng.integers(2)),
        rng.uniform(0, 0.25),
        dim,
    )


def _pictures(drawn: Drawn, rng: np.random.Generator, num: int = 6) -> list[np.ndarray]:
    """Grey pictures (h, w) uint8 of a scene that changes, sampled four times a pixel."""
    offsets = (np.arange(2) + 0.5) / 2
    v = (np.arange(drawn.height)[:, None] + offsets).ravel()[:, None]
    u = (np.arange(drawn.width)[:, None] + offsets).ravel()[None]
    away = np.hypot(u - drawn.x, v - drawn.y) / drawn.radius
    around = np.arctan2(v - drawn.y, u - drawn.x)
    shadow = (np.abs(around - np.pi / 2) < np.pi * drawn.dark_share) & (away > 0.5)
    least = np.where(shadow, -np.inf, 30).astype(np.float32)
    most = np.where(shadow, 45, np.inf).astype(np.float32)
    inside = away < 1
    vignetting = drawn.dim * (1 - 0.35 * np.minimum(away, 1) ** 4)
    fade = 1.0 if drawn.sharp_end else np.clip((1.35 - away) / 0.35, 0, 1)
    end = drawn.glow_end if drawn.sharp_end else 1.35
    side = 0.7 + 0.3 * np.cos(around - 2.0)  # a housing glows towards the sun
    outside = np.where(away < end, np.maximum(drawn.glow * side * fade, 3), 3).astype(np.float32)
    flare = np.zeros(1, np.float32)
    if drawn.flare:
        flare = 160 * np.exp(-((away - 1.05) ** 2) / 0.02 - (around + 2.2) ** 2 / 0.02)
        flare = flare.astype(np.float32)
    out = []
    for _ in range(num):
        coarse = rng.uniform(70, 220, (14, 14)).astype(np.float32)
        scene = cv2.resize(coarse, away.shape[::-1], interpolation=cv2.INTER_CUBIC)
        fine = rng.uniform(-1, 1, (60, 60)).astype(np.float32)
        scene = scene + 25 * cv2.resize(fine, away.shape[::-1], interpolation=cv2.INTER_CUBIC)
        scene *= vignetting
        picture = np.where(inside, np.clip(scene, least, most), outside) + flare
        small = cv2.resize(picture, (drawn.width, drawn.height), interpolation=cv2.INTER_AREA)
        noisy = small + rng.normal(0, 1.5, small.shape)
        out.append(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    return out


@pytest.mark.parametrize("seed", range(20))
def test_drawn_circles_are_found_within_a_hundredth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drawn = _draw(rng)
    found = find_circle(_pictures(drawn, rng)).circle
    assert found is not None, drawn
    off = np.hypot(found.x - drawn.x, found.y - drawn.y), found.radius - drawn.radius
    assert np.abs(off).max() < 0.01 * drawn.radius, (off, drawn)
    assert found.support >= 0.5 and 0 < found.sigma < 0.01 * drawn.radius


def test_the_same_circle_every_time() -> None:
    drawn = _draw(np.random.default_rng(3))
    pictures = _pictures(drawn, np.random.default_rng(3))
    assert find_circle(pictures) == find_circle(pictures)


@pytest.mark.parametrize("kind", ["lit", "dark", "texture", "stripes"])
def test_pictures_without_a_circle_say_what_was_seen(kind: str) -> None:
    rng = np.random.default_rng(0)
    pictures = np.full((5, 400, 400), 120 if kind == "lit" else 4, np.uint8)
    if kind == "texture":
        coarse = rng.integers(20, 250, (5, 25, 25)).astype(np.uint8)
        pictures = np.stack([cv2.resize(one, (400, 400)) for one in coarse])
    if kind == "stripes":
        pictures[:, :, ::40] = pictures[:, :, 1::40] = 255
    search = find_circle(list(pictures))
    assert search.circle is None
    grey = {"lit": "120 in the middle, 120", "dark": "4 in the middle, 4"}.get(kind, "median grey")
    assert grey in search.sighting()
    assert ("no edges" in search.sighting()) == (search.best is None)


def _halves(squeeze: float, seed: int = 0) -> list[np.ndarray]:
    """Pictures of two circles side by side, their height a share of what it was."""
    rng = np.random.default_rng(seed)
    lens = Drawn(480, 480, 243, 238, 238, 60, 1.1, True, True, 0.1, 1.0)
    pairs = zip(_pictures(lens, rng), _pictures(lens, rng), strict=True)
    beside = [np.concatenate(pair, axis=1) for pair in pairs]
    return [cv2.resize(one, (960, round(480 * squeeze))) for one in beside]


@pytest.mark.parametrize("squeeze", [1.0, 1.125])
def test_glowing_and_squeezed_pairs_are_recognised(squeeze: float) -> None:
    pictures = _halves(squeeze)
    height = round(480 * squeeze)
    found = recognise(pictures, (960, height), Path("x"))
    assert found.lens_size == (480, 480)
    assert ("960x540 is read as 960x480" in found.notes[0]) == (squeeze != 1)


def test_round_circles_in_a_higher_picture_stay_round() -> None:
    pictures = [np.pad(one, ((12, 48), (0, 0))) for one in _halves(1.0)]
    found = recognise(pictures, (960, 540), Path("x"))
    assert found.lens_size == (480, 540)
    assert abs(found.top - 10) < 4  # a square around the circles


@pytest.mark.parametrize("size", [(960, 540), (960, 480)])
def test_ordinary_pictures_are_no_pairs(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    for level in (30, 200):
        coarse = rng.integers(0, level, (5, 20, 36)).astype(np.uint8)
        pictures = [cv2.resize(one, size) for one in coarse]
        assert recognise(pictures, size, Path("x")).lens_size is None


@pytest.mark.skipif(not (REAL / "fusion_wood").is_dir(), reason="real captures are not here")
@pytest.mark.parametrize("name, x, y, radius", [("FR", 1353, 1314, 1352), ("BK", 1344, 1308, 1356)])
def test_fusion_circles(name: str, x: float, y: float, radius: float) -> None:
    """Centre and radius as measured by eye on the pictures, to 5 pixels."""
    paths = sorted((REAL / "fusion_wood" / name).iterdir())
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths]
    found = find_circle([picture for picture in pictures if picture is not None]).circle
    assert found is not None and found.support > 0.9
    assert max(abs(found.x - x), abs(found.y - y), abs(found.radius - radius)) < 0.01 * radius


@pytest.mark.skipif(not (REAL / "max_eac").is_dir(), reason="real captures are not here")
def test_cube_faces_and_panoramas_have_no_circles() -> None:
    for folder in ("track0", "STITCHED"):
        paths = [p for p in sorted((REAL / "max_eac" / folder).iterdir()) if p.suffix != ".txt"]
        pictures = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in paths]
        shown = [picture for picture in pictures if picture is not None]
        half = shown[0].shape[1] // 2
        assert find_circle([picture[:, :half] for picture in shown]).circle is None
