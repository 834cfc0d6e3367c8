"""Bearings of points as a family: their noise is that of the faces that show them."""

import numpy as np
from synthetic import unit

from factors import tangent_basis
from gsba.bundle.families import Bearings, PointObservations
from gsba.camera.rig import CubeRig, owner_faces

RIG = CubeRig(512, np.deg2rad(95))


def _observed(num: int, sqrt_infos: np.ndarray | None = None) -> PointObservations:
    rng = np.random.default_rng(3)
    bearings = unit(rng.normal(size=(num, 3)))
    faces = owner_faces(bearings)
    rows, pixels = np.arange(num), RIG.project(bearings, faces)
    sigmas = rng.uniform(1e-4, 1e-3, num)
    return PointObservations(rows, rows, bearings, sigmas, sqrt_infos, None, faces, pixels)


def test_noise_is_equal_along_both_axes_of_the_face() -> None:
    observed = _observed(500)
    (term,) = Bearings().landmark_terms(observed)
    axes, step = tangent_basis(observed.bearings_rig), 1e-4
    moved = np.empty((500, 2, 2))  # radians on the tangent basis by pixels
    for c in range(2):
        there = observed.pixels + step * np.eye(2)[c]
        for face in range(6):
            rows = observed.faces == face
            change = (RIG.bearings(there[rows], face) - observed.bearings_rig[rows]) / step
            moved[rows, :, c] = np.einsum("oij,oj->oi", axes[rows], change)
    whitened = term.sqrt_infos @ moved
    information = np.swapaxes(whitened, 1, 2) @ whitened  # of pixels
    np.testing.assert_allclose(information[:, 0, 1], 0, atol=1e-4 * information[:, 0, 0].min())
    np.testing.assert_allclose(information[:, 0, 0], information[:, 1, 1], rtol=1e-3)
    spread = 1 / np.sqrt(np.linalg.det(term.sqrt_infos))
    np.testing.assert_allclose(spread, observed.sigmas_rad, rtol=1e-9)


def test_noise_that_is_known_stays() -> None:
    roots = np.random.default_rng(4).normal(size=(20, 2, 2))
    (term,) = Bearings().landmark_terms(_observed(20, roots))
    assert term.sqrt_infos is roots
