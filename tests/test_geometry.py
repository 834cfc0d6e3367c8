"""Closed-form geometry and the cube rig."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsba.camera.rig import RIG_R_FACE, CubeRig, owner_faces
from gsba.camera.sphere import bearings_from_erp, erp_from_bearings
from gsba.geometry import (
    inverse,
    pose,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_quaternion,
    standing_length,
    typical_length,
)
from gsba.similarity import NoSimilarityError, Sim3, pose_similarity, residuals_of, similarity
from gsba.types import FACES

WIDTH, HEIGHT = 800, 400
AXES = {
    "front": [0, 0, 1],
    "right": [1, 0, 0],
    "back": [0, 0, -1],
    "left": [-1, 0, 0],
    "up": [0, -1, 0],
    "down": [0, 1, 0],
}


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _poses(num: int, rng: np.random.Generator) -> np.ndarray:
    return pose(Rotation.random(num, rng).as_matrix(), rng.normal(size=(num, 3)))


@pytest.mark.parametrize(
    ("pixel", "bearing"),
    [
        ((WIDTH / 2, HEIGHT / 2), AXES["front"]),
        ((3 * WIDTH / 4, HEIGHT / 2), AXES["right"]),
        ((WIDTH / 4, HEIGHT / 2), AXES["left"]),
        ((0, HEIGHT / 2), AXES["back"]),
        ((WIDTH, HEIGHT / 2), AXES["back"]),
        ((123, 0), AXES["up"]),
        ((123, HEIGHT), AXES["down"]),
        ((WIDTH / 2, HEIGHT / 4), _unit(np.array([0, -1.0, 1.0]))),
    ],
)
def test_erp_pixels_look_where_they_should(pixel: tuple, bearing: list) -> None:
    found = bearings_from_erp(np.array(pixel, float), WIDTH, HEIGHT)
    np.testing.assert_allclose(found, bearing, atol=1e-15)


def test_erp_pixel_centres_stand_symmetrically() -> None:
    """The centre of the top-left pixel is (0.5, 0.5): first and last column mirror each other."""
    first = bearings_from_erp(np.array([0.5, 0.5]), WIDTH, HEIGHT)
    last = bearings_from_erp(np.array([WIDTH - 0.5, 0.5]), WIDTH, HEIGHT)
    np.testing.assert_allclose(first, last * [-1, 1, 1], atol=1e-15)
    assert np.arctan2(-first[0], -first[2]) == pytest.approx(np.pi / WIDTH)
    assert np.pi / 2 + np.arcsin(-first[1]) == pytest.approx(np.pi - np.pi / (2 * HEIGHT))


@given(st.floats(0, WIDTH, exclude_max=True), st.floats(1e-3, HEIGHT - 1e-3))
def test_erp_round_trip(u: float, v: float) -> None:
    bearing = bearings_from_erp(np.array([u, v]), WIDTH, HEIGHT)
    assert np.linalg.norm(bearing) == pytest.approx(1, abs=1e-15)
    back = erp_from_bearings(3.7 * bearing, WIDTH, HEIGHT)  # any length
    assert back[1] == pytest.approx(v, abs=1e-9)
    around = (back[0] - u + WIDTH / 2) % WIDTH - WIDTH / 2  # 0 and WIDTH are one column
    # 1e-3 px from a pole the column is known to the rounding of x and z, 1e5 times larger.
    assert around == pytest.approx(0, abs=1e-8)
    assert 0 <= back[0] <= WIDTH


def test_quaternions_against_scipy(rng: np.random.Generator) -> None:
    rotations = Rotation.random(50, rng)
    wxyz = rotations.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(rotation_from_quaternion(wxyz), rotations.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(
        quaternion_from_rotation(rotations.as_matrix()[None]), wxyz[None], atol=1e-15
    )


@pytest.mark.parametrize("angle", [0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
def test_rotation_angle_is_accurate_at_both_ends(angle: float, rng: np.random.Generator) -> None:
    rotations = Rotation.from_rotvec(angle * _unit(rng.normal(size=(20, 3)))).as_matrix()
    np.testing.assert_allclose(rotation_angle(rotations), angle, rtol=1e-6, atol=1e-15)


def test_inverse_undoes(rng: np.random.Generator) -> None:
    world_T_rigs = _poses(7, rng)
    identities = np.broadcast_to(np.eye(4), (7, 4, 4))
    np.testing.assert_allclose(inverse(world_T_rigs) @ world_T_rigs, identities, atol=1e-14)


def _sim3() -> tuple[float, np.ndarray, np.ndarray]:
    return 2.7, Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), np.array([4.0, -5.0, 0.6])


@pytest.mark.parametrize("flat", [False, True])
def test_similarity_recovers_a_known_one(flat: bool, rng: np.random.Generator) -> None:
    scale, rotation, translation = _sim3()
    source = rng.normal(size=(30, 3)) * ([1, 1, 0] if flat else [1, 1, 1])
    target = scale * source @ rotation.T + translation
    found = similarity(source, target)
    assert found.scale == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, translation, atol=1e-12)


def test_similarity_never_mirrors(rng: np.random.Generator) -> None:
    source = rng.normal(size=(30, 3))
    found = similarity(source, source * [-1, 1, 1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_similarity_is_the_least_squares_one(rng: np.random.Generator) -> None:
    source = rng.normal(size=(40, 3))
    target = 1.4 * source + rng.normal(0, 0.3, source.shape)

    def cost(fit: Sim3) -> float:
        return float(np.sum(residuals_of(fit, source, target) ** 2))

    found = similarity(source, target)
    best = cost(found)
    for _ in range(50):
        nudge = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()
        scale, shift = found.scale + rng.normal(0, 1e-3), rng.normal(0, 1e-3, 3)
        assert cost(Sim3(scale, nudge @ found.rotation, found.translation + shift)) >= best


@pytest.mark.parametrize("path", ["room", "straight line", "one place"])
def test_pose_similarity_recovers_a_known_one(path: str, rng: np.random.Generator) -> None:
    scale, rotation, translation = _sim3()
    source = _poses(20, rng)
    if path == "straight line":
        source[:, :3, 3] = np.linspace(0, 9, 20)[:, None] * [0.1, 0.2, 1]
    if path == "one place":  # no scale to be had: 1
        source[:, :3, 3], scale = [1.0, 2.0, 3.0], 1.0
    target = pose(rotation @ source[:, :3, :3], scale * source[:, :3, 3] @ rotation.T + translation)
    found = pose_similarity(source, target)
    assert found.scale == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, translation, atol=1e-12)


def test_pose_similarity_never_mirrors() -> None:
    source, target = _poses(3, np.random.default_rng(3)), _poses(3, np.random.default_rng(4))
    inverted = []
    for shift in range(20):
        target[:, :3, :3] = Rotation.random(3, np.random.default_rng(shift)).as_matrix()
        try:
            fit = pose_similarity(source, target)
        except NoSimilarityError:  # turned so, no positive scale lays one over the other
            inverted.append(shift)
            continue
        assert fit.scale > 0 and np.linalg.det(fit.rotation) == pytest.approx(1)
    assert 0 < len(inverted) < 20


def test_a_similarity_never_inverts_or_vanishes() -> None:
    rng = np.random.default_rng(5)
    source = _poses(6, rng)
    inverted = source.copy()
    inverted[:, :3, 3] *= -1
    for target in (inverted, np.tile(np.eye(4), (6, 1, 1))):
        with pytest.raises(NoSimilarityError, match="no positive scale"):
            pose_similarity(source, target)
    with pytest.raises(NoSimilarityError):
        similarity(source[:, :3, 3], np.ones((6, 3)))
    assert similarity(np.ones((6, 3)), source[:, :3, 3]).scale == 1  # no motion tells no scale


def test_faces_come_in_order_and_look_along_their_axes() -> None:
    assert FACES == ("front", "right", "back", "left", "up", "down")
    for face, name in enumerate(FACES):
        np.testing.assert_array_equal(RIG_R_FACE[face, :, 2], AXES[name])
        assert np.linalg.det(RIG_R_FACE[face]) == 1
        assert owner_faces(np.array(AXES[name], float)) == face


def test_side_faces_stand_upright_and_poles_continue_the_front() -> None:
    for name in ("front", "right", "back", "left"):  # image down is rig down
        np.testing.assert_array_equal(RIG_R_FACE[FACES.index(name), :, 1], AXES["down"])
    for name in ("up", "down"):  # image right is rig right, as on the front face
        np.testing.assert_array_equal(RIG_R_FACE[FACES.index(name), :, 0], AXES["right"])


def test_face_pixels_follow_the_pinhole_model() -> None:
    rig = CubeRig(200, np.pi / 2)
    assert rig.focal == pytest.approx(100) and rig.principal == 100
    corner = rig.bearings(np.array([0.0, 0.0]), FACES.index("front"))
    np.testing.assert_allclose(corner, _unit(np.array([-1.0, -1.0, 1.0])), atol=1e-15)
    half = rig.bearings(np.array([150.0, 100.0]), FACES.index("right"))
    np.testing.assert_allclose(half, _unit(np.array([1.0, 0.0, -0.5])), atol=1e-15)


@pytest.mark.parametrize("hfov_deg", [90, 96, 120])
def test_face_round_trip(hfov_deg: float, rng: np.random.Generator) -> None:
    rig = CubeRig(320, np.deg2rad(hfov_deg))
    pixels, faces = rng.uniform(0, 320, (500, 2)), rng.integers(0, 6, 500)
    bearings = rig.bearings(pixels, faces)
    np.testing.assert_allclose(np.linalg.norm(bearings, axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(rig.project(5 * bearings, faces), pixels, atol=1e-10)


def test_project_is_nan_behind_the_face() -> None:
    rig = CubeRig(320, np.pi / 2)
    assert np.isnan(rig.project(np.array(AXES["back"], float), FACES.index("front"))).all()
    assert np.isnan(rig.project(np.array(AXES["right"], float), FACES.index("front"))).all()


def test_every_bearing_has_an_owner_that_sees_it(rng: np.random.Generator) -> None:
    rig = CubeRig(320, np.pi / 2)
    bearings = _unit(rng.normal(size=(2000, 3)))
    owners = owner_faces(bearings)
    pixels = rig.project(bearings, owners)
    assert (np.abs(pixels - 160) <= 160 + 1e-9).all()
    assert len(np.unique(owners)) == 6


def test_a_camera_that_mostly_stands_has_the_typical_length_of_its_walked_steps() -> None:
    shaken = np.full(20, 2e-3)
    assert typical_length(np.append(shaken, [0.8, 0.9, 1.0, 1.1, 1.2])) == 1.0
    assert typical_length(np.append(shaken, [0.8, 0.9, 1.0, 1.1, 900.0])) == 1.0
    assert typical_length(np.array([0.3, 0.5, 0.9])) == 0.5
    assert typical_length(np.zeros(4)) == typical_length(np.zeros(0)) == 1.0
    assert (shaken < standing_length(np.append(shaken, np.ones(4)))).all()
