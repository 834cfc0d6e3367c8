"""Fisheyes: projection against OpenCV's and back, how rays change with a lens, other lenses."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import unit
from two_fisheyes import made_pair

from gsba.camera.fisheye import (
    PARAMETERS,
    by_parameters,
    changed,
    difference,
    pixels_of,
    project,
    recalibrated,
    rotation_of,
    turned,
    unproject,
)
from gsba.types import Fisheye

PAIR = made_pair()
LENSES = pytest.mark.parametrize("lens", PAIR, ids=["front", "back"])
STEP = np.array([0.02, 0.03, -0.01, 0.004, -0.002, 0.0005, -0.00004, 0.02, -0.01, 0.03])


def _directions(lens: Fisheye, furthest_deg: float, num: int = 400) -> np.ndarray:
    """Unit directions (N, 3) in the rig within an angle of a lens's axis, this and the rim too."""
    rng = np.random.default_rng(4)
    angles = np.deg2rad(furthest_deg) * np.sqrt(rng.uniform(0, 1, num))
    angles[:3] = 0, 1e-6, np.deg2rad(furthest_deg)
    around = rng.uniform(0, 2 * np.pi, num)
    local = np.stack(
        [np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around), np.cos(angles)], axis=1
    )
    return local @ rotation_of(lens).T


@LENSES
def test_pixels_are_those_of_opencv(lens: Fisheye) -> None:
    directions = _directions(lens, 85)
    local = directions @ rotation_of(lens)
    camera = np.diag([lens.focal, lens.focal, 1.0])
    camera[:2, 2] = lens.principal
    zero = np.zeros(3)
    expected, _ = cv2.fisheye.projectPoints(
        local[:, None], zero, zero, camera, np.array(lens.radial)
    )
    np.testing.assert_allclose(project(lens, directions), expected[:, 0], atol=1e-9)


@LENSES
def test_there_and_back(lens: Fisheye) -> None:
    directions = _directions(lens, 110)
    pixels = project(lens, 3.7 * directions)
    np.testing.assert_allclose(pixels[0], lens.principal, atol=1e-9)
    np.testing.assert_allclose(unproject(lens, pixels), directions, atol=1e-10)
    np.testing.assert_allclose(project(lens, unproject(lens, pixels)), pixels, atol=1e-9)
    shaped = pixels.reshape(20, 20, 2)
    np.testing.assert_array_equal(
        unproject(lens, shaped), unproject(lens, pixels).reshape(20, 20, 3)
    )


@LENSES
def test_rays_change_with_the_lens_as_they_are_said_to(lens: Fisheye) -> None:
    directions = _directions(lens, 100)[1:]  # on the axis itself the way across is none
    pixels = project(lens, directions)
    found = by_parameters(lens, directions)
    assert found.shape == (len(directions), 3, PARAMETERS)
    for column in range(PARAMETERS):
        step = np.zeros(PARAMETERS)
        step[column] = 1e-7
        ahead, behind = (unproject(changed(lens, sign * step), pixels) for sign in (1, -1))
        numeric = (ahead - behind) / 2e-7
        what = f"column {column}"
        np.testing.assert_allclose(found[:, :, column], numeric, rtol=1e-6, atol=1e-7, err_msg=what)
    along = np.einsum("ni,nij->nj", directions, found)
    np.testing.assert_allclose(along, 0, atol=1e-12)  # rays stay of length one


@LENSES
def test_steps_and_differences_are_inverse(lens: Fisheye) -> None:
    other = changed(lens, STEP)
    assert other.centre == lens.centre and (other.width, other.height) == (240, 240)
    np.testing.assert_allclose(difference(other, lens), STEP, atol=1e-12)
    again = changed(lens, difference(PAIR[0], lens))
    for name in ("focal", "principal", "radial", "rotation"):
        expected = getattr(PAIR[0], name)
        np.testing.assert_allclose(getattr(again, name), expected, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(difference(lens, lens), 0)


def test_each_direction_is_of_the_lens_that_faces_it() -> None:
    directions = np.random.default_rng(1).normal(size=(50, 2, 3))
    directions[0, 0] = 1, 0.5, 0  # on the seam
    lens, pixels = pixels_of(PAIR, directions)
    np.testing.assert_array_equal(lens, directions[..., 2] < 0)
    for number, one in enumerate(PAIR):
        of_it = lens == number
        np.testing.assert_array_equal(pixels[of_it], project(one, directions[of_it]))


def test_other_lenses_keep_pixels() -> None:
    directions = unit(np.random.default_rng(2).normal(size=(300, 3)))
    after = changed(PAIR[0], STEP), changed(PAIR[1], -STEP)
    found = recalibrated(directions, PAIR, after)
    behind = directions[:, 2] < 0
    for part, old, new in zip((~behind, behind), PAIR, after, strict=True):
        np.testing.assert_allclose(
            project(new, found[part]), project(old, directions[part]), atol=1e-9
        )
    assert np.linalg.norm(found - directions, axis=1).min() > 1e-4
    np.testing.assert_allclose(recalibrated(directions, PAIR, PAIR), directions, atol=1e-10)


def test_in_other_axes_of_the_rig_pixels_stay() -> None:
    old_R_new = Rotation.from_rotvec([0.2, -0.5, 0.1]).as_matrix()
    directions = np.random.default_rng(3).normal(size=(50, 3))
    for lens, same in zip(PAIR, turned(PAIR, old_R_new), strict=True):
        np.testing.assert_allclose(
            project(same, directions @ old_R_new), project(lens, directions), atol=1e-9
        )
