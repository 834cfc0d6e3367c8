"""How surfaces lie, by the affine parts of patches that were carried facing their host."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from factors import tangent_basis
from factors.patches import Sightings, expect
from gsba.photometric.alignment import (
    coverage_differences,
    depth_shifts,
    shown_slopes,
    slopes_of,
    surface_normals,
)

STEP = 2 * np.pi / 1536
POINT = np.array([0.4, -0.3, 2.0])  # seen from the host at the origin
DEPTH = np.linalg.norm(POINT)
ORIGIN = POINT / DEPTH
SPREAD = STEP * tangent_basis(ORIGIN[None])[0].T
VIEWS = [[0.5, 0.1, 0.2], [-0.4, 0.3, -0.3], [0.1, -0.6, 0.4]]
TEXTURE = np.random.default_rng(3).normal(size=(4, 4)) + 3 * np.eye(4)
INFORMATION = 50 * TEXTURE @ TEXTURE.T  # on affine parts, as an uneven texture gives it


def _surface(tilt_deg: float, turn_deg: float) -> np.ndarray:
    """A normal that much off the ray, pointing away from the host."""
    axes = SPREAD / STEP
    turn = np.deg2rad(turn_deg)
    across = axes @ np.array([np.cos(turn), np.sin(turn)])
    return np.cos(np.deg2rad(tilt_deg)) * ORIGIN + np.sin(np.deg2rad(tilt_deg)) * across


def _affine(normal: np.ndarray, slopes: np.ndarray, R: np.ndarray, centre: np.ndarray) -> tuple:
    """How the patch of a surface turns out in a frame, its bearing, axes and host's ray there."""
    ahead = R.T @ (POINT - centre)
    distance = np.linalg.norm(ahead)
    axes = R.T @ (DEPTH * (SPREAD + ORIGIN[:, None] * slopes)) / distance
    origin, half = ahead / distance, 1e-3

    def found(q: np.ndarray) -> np.ndarray:
        ray = ORIGIN + (SPREAD + ORIGIN[:, None] * slopes) @ q
        ray = R.T @ (ray * (normal @ POINT) / (normal @ ray) - centre)
        there = np.column_stack([axes, -ray])
        return np.linalg.solve(there, -origin)[:2]

    columns = [(found(half * e) - found(-half * e)) / (2 * half) for e in np.eye(2)]
    return np.column_stack(columns) - np.eye(2), origin, axes, R.T @ POINT / distance


def _normal(surface: np.ndarray, slopes: np.ndarray, prior: float = 0.0) -> np.ndarray:
    """The normal that three views of a surface show, carried with these slopes; affine parts are
    drawn to zero by a prior of this information."""
    turns = Rotation.from_rotvec([[0.1, 0.2, 0], [0, -0.3, 0.1], [0.2, 0, 0]]).as_matrix()
    given = zip(turns, np.array(VIEWS), strict=True)
    parts = [_affine(surface, slopes, R, centre) for R, centre in given]
    origins, axes, rays = (np.array([part[i] for part in parts]) for i in (1, 2, 3))
    sightings = expect(np.zeros(3, np.int64), origins, axes)
    posterior = INFORMATION + prior * np.eye(4)
    for warp, part in zip(sightings.warps, parts, strict=True):
        warp[2:] = np.linalg.solve(posterior, INFORMATION @ part[0].T.ravel())
    return _from_sightings(sightings, rays, slopes, posterior)


def _from_sightings(
    sightings: Sightings, rays: np.ndarray, slopes: np.ndarray, posterior: np.ndarray
) -> np.ndarray:
    """The normal from sightings of one template, none of them shifted."""
    sightings.variances[:] = 1e-2
    shifts = depth_shifts(sightings.spreads, sightings.origins, rays)
    known = (np.tile(one, (len(shifts), 1, 1)) for one in (posterior, INFORMATION))
    shown = shown_slopes(shifts, sightings.warps, sightings.variances, *known)
    own = slopes[None], ORIGIN[None], SPREAD[None]
    return surface_normals(sightings.templates, *shown, *own)[0]


@pytest.mark.parametrize("tilt", [0, 20, 45, 65])
@pytest.mark.parametrize("turn", [0, 130, 250])
def test_affine_parts_tell_how_a_surface_lies(tilt: float, turn: float) -> None:
    surface = _surface(tilt, turn)
    found = _normal(surface, np.zeros(2))
    cosine = found @ surface / np.linalg.norm(found)
    assert np.degrees(np.arccos(min(cosine, 1))) < 3  # the prior draws it to the ray a little
    slopes = slopes_of(found[None], ORIGIN[None], SPREAD[None])[0]
    again = _normal(surface, slopes)  # where it lies already, it stays
    assert again @ surface / np.linalg.norm(again) == pytest.approx(1, abs=2e-3)


def test_the_prior_of_affine_parts_does_not_draw_surfaces() -> None:
    surface, slopes = _surface(45, 130), np.zeros(2)
    np.testing.assert_allclose(_normal(surface, slopes, prior=400.0), _normal(surface, slopes))


def test_slopes_are_those_of_the_surface() -> None:
    surface = _surface(40, 70)
    slopes = slopes_of(surface[None], ORIGIN[None], SPREAD[None])[0]
    for step in np.eye(2):
        ray = ORIGIN + SPREAD @ step
        depth = (surface @ ORIGIN) / (surface @ ray)
        assert depth == pytest.approx(1 + slopes @ step, abs=1e-4)


def test_pixels_of_two_pictures_cover_a_surface_differently() -> None:
    rng = np.random.default_rng(0)
    axes = STEP * (np.eye(2) + 0.2 * rng.normal(size=(50, 2, 2)))
    steps = rng.uniform(1, 1.4, 50)
    found = coverage_differences(axes, STEP, steps)
    square = STEP * np.eye(2)
    for one, step, difference in zip(axes, steps, found, strict=True):
        covered = np.linalg.solve(one, square)  # edges of a pixel, in template pixels
        assert difference == pytest.approx(
            np.linalg.norm(covered @ covered.T - np.eye(2) / step**2), rel=1e-9
        )


def test_steep_and_unknown_surfaces() -> None:
    steep, away = _surface(89, 0), -_surface(20, 0)
    given = np.array([steep, np.zeros(3), away])
    own = np.tile(ORIGIN, (3, 1)), np.tile(SPREAD, (3, 1, 1))
    slopes = slopes_of(given, *own) / STEP
    assert np.linalg.norm(slopes[0]) == pytest.approx(3)
    assert not slopes[1:].any()


def test_a_point_without_parallax_tells_nothing() -> None:
    """Seen from its host's ray, a surface turns by nothing, however it lies."""
    affine, origin, axes, ray = _affine(_surface(50, 0), np.zeros(2), np.eye(3), 0.3 * ORIGIN)
    sightings = expect(np.zeros(1, np.int64), origin[None], axes[None])
    sightings.warps[0, 2:] = affine.T.ravel()
    assert not _from_sightings(sightings, ray[None], np.zeros(2), INFORMATION).any()
