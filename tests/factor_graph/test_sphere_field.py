"""Fields on the sphere: orthonormal, free of rotations, undone exactly, right Jacobians."""

import numpy as np
import pytest
from synthetic import unit

from factors import tangent_basis
from factors.sphere_field import SphereField, degree_of, degrees_of, harmonics, num_harmonics

RNG = np.random.default_rng(0)
EDGES = np.vstack([np.eye(3), -np.eye(3), unit(np.array([[1e-9, 1, 0], [0, 1e-9, -1.0]]))])
BEARINGS = np.vstack([unit(RNG.normal(size=(40, 3))), EDGES])


def _quadrature(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights that integrate polynomials of degree 2 num - 1 over the sphere."""
    z, weights = np.polynomial.legendre.leggauss(num)
    around = 2 * np.pi * np.arange(2 * num) / (2 * num)
    z, around = np.repeat(z, 2 * num), np.tile(around, num)
    flat = np.sqrt(1 - z * z)
    directions = np.column_stack([flat * np.cos(around), flat * np.sin(around), z])
    return directions, np.repeat(weights, 2 * num) * np.pi / num


def _field(degree: int, rms_rad: float, seed: int = 1) -> SphereField:
    drawn = np.random.default_rng(seed).normal(size=num_harmonics(degree))
    return SphereField(drawn * rms_rad * np.sqrt(4 * np.pi) / np.linalg.norm(drawn))


def test_harmonics_are_orthonormal_and_tangent() -> None:
    directions, weights = _quadrature(9)
    found = harmonics(directions, 7)
    gram = np.einsum("n,nik,nil->kl", weights, found, found)
    np.testing.assert_allclose(gram, np.eye(num_harmonics(7)), atol=1e-12)
    assert np.abs(np.einsum("ni,nik->nk", directions, found)).max() < 1e-12


def test_no_field_holds_a_rotation() -> None:
    directions, weights = _quadrature(8)
    turns = np.cross(np.eye(3)[:, None], directions[None])
    shared = np.einsum("n,ani,nik->ak", weights, turns, harmonics(directions, 6))
    assert np.abs(shared).max() < 1e-12


def test_first_gradients_are_the_axes() -> None:
    along = np.sqrt(3 / (8 * np.pi)) * (np.eye(3) - BEARINGS[:, :, None] * BEARINGS[:, None, :])
    np.testing.assert_allclose(harmonics(BEARINGS, 1), along[:, :, [2, 0, 1]], atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 12])
def test_counts(degree: int) -> None:
    num = num_harmonics(degree)
    assert degree_of(num) == degree and len(degrees_of(num)) == num
    assert harmonics(BEARINGS, degree).shape == (len(BEARINGS), 3, num)


def test_lower_degrees_come_first() -> None:
    np.testing.assert_array_equal(
        harmonics(BEARINGS, 6)[:, :, : num_harmonics(3)], harmonics(BEARINGS, 3)
    )
    with pytest.raises(ValueError, match="no degree has 5"):
        degree_of(5)


def test_displacements_sum_harmonics() -> None:
    field = _field(8, 0.01)
    expected = harmonics(BEARINGS, 8) @ field.coefficients
    np.testing.assert_allclose(field.displacements(BEARINGS), expected, atol=1e-15)
    directions, weights = _quadrature(10)
    squared = np.sum(field.displacements(directions) ** 2, axis=1)
    assert np.sqrt(weights @ squared / (4 * np.pi)) == pytest.approx(field.rms_rad)


def test_correction_is_an_arc_and_can_be_undone() -> None:
    field = _field(6, np.deg2rad(0.3))
    moved = field.corrected(BEARINGS)
    angles = np.arctan2(
        np.linalg.norm(np.cross(moved, BEARINGS), axis=1), np.sum(moved * BEARINGS, axis=1)
    )
    lengths = np.linalg.norm(field.displacements(BEARINGS), axis=1)
    np.testing.assert_allclose(angles, lengths, rtol=1e-9)
    np.testing.assert_allclose(field.observed(moved), BEARINGS, atol=1e-12)
    none = SphereField.none()
    assert not none and none.corrected(BEARINGS) is BEARINGS and none.observed(moved) is moved


def test_information_turns_with_the_basis(rng: np.random.Generator) -> None:
    """Also where the basis jumps, at z = 0."""
    field = _field(4, 0.01)
    level = unit(np.column_stack([rng.normal(size=(30, 2)), rng.normal(0, 1e-3, 30)]))
    roots = rng.normal(size=(30, 2, 2))
    there = field.corrected(level)
    turned = field.corrected_roots(level, roots)
    in_space = [
        np.einsum("nki,nij->nkj", r, tangent_basis(b)) for r, b in ((roots, level), (turned, there))
    ]
    np.testing.assert_allclose(in_space[0], in_space[1], atol=0.05 * np.abs(roots).max())
    assert np.any(level[:, 2] * there[:, 2] < 0)
