"""Calibrations as Insta360 writes them, as lenses for pictures of any size."""

import insta360_files as made
import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.camera.factory_lenses import FactoryCalibration, FactoryLenses, parse_factory_lenses
from gsba.camera.fisheye import Pair, project, rotation_of
from gsba.log import GsbaError
from gsba.types import Fisheye

X4_FIRST = (  # of one camera, as all three: published in the notes of a project on GitHub
    "2_2905.65_3989.5_3006.75_0.371_0.209_90.52_2891.65_11997.71_3013.87_-0.412_0.198_89.639"
    "_16000_6000_1095"
)
X4_SECOND = (
    "2_2897.52_3989.48_3004.11_0.276_0.29_90.535_0.0_0.0_0.0_1.0_-0.20175603_0.34253067_-0.12655279"
    "_16000_6000_71_2883.42_11997.0_3011.52_-0.409_0.3_89.625_-0.001606_-0.000255_-0.030557_1.0"
    "_-0.19953983_0.34139037_-0.12675293_16000_6000_71_132096"
)
SIXTH = (  # the third with the terms that it has more, all zero
    made.X4_THIRD.replace("_-0.00147663_0.00045841_", "_0_0" + 8 * "_0" + "_")
    .replace("_-0.00139833_0.00011861_", "_0_0" + 8 * "_0" + "_")
    .replace("197632", "394240")
)
SIDEWAYS = np.deg2rad(np.linspace(2, 98, 25))
X4_WINDOW = {"sensor": (8000, 6000), "window": (5760, 5760)}
# Relative, by generation: the first one takes lenses for equidistant; those of an X4 are not.
FOCAL_SIGMAS = {1: 0.05, 2: 0.01, 6: 0.005}


def _radii(lens: Fisheye) -> np.ndarray:
    """Pixels from the centre, at SIDEWAYS from the axis."""
    local = np.stack([np.sin(SIDEWAYS), 0 * SIDEWAYS, np.cos(SIDEWAYS)], axis=-1)
    return np.hypot(*(project(lens, local @ rotation_of(lens).T) - lens.principal).T)


def _parse(text: str, **more) -> FactoryLenses:
    return parse_factory_lenses(FactoryCalibration(text, **more))


def _turn(pair: Pair) -> np.ndarray:
    """Rotation (3,) of the back lens from half a turn against the front one, degrees."""
    front, back = map(rotation_of, pair)
    vector = Rotation.from_matrix(np.diag([-1, 1, -1]) @ front.T @ back).as_rotvec()
    return np.rad2deg(vector)


def test_the_first_generation_is_scaled_to_the_window() -> None:
    """Of 3040 pixels of a sensor 2880 are recorded, in pictures of 1440."""
    found = _parse(made.ONE_R, sensor=(3040, 3040), window=(2880, 2880))
    assert (found.generation, found.canvas, found.angles_known) == (1, (3040, 3040), True)
    usual, whole = found.pairs((1440, 1440))
    front, back = usual
    assert (front.width, front.height) == (1440, 1440)
    assert front.focal == pytest.approx(1480.5 / np.deg2rad(100) / 2)
    np.testing.assert_allclose(front.principal, np.subtract([1517.5, 1520.1], 80) / 2)
    np.testing.assert_allclose(back.principal, np.subtract([4553.1 - 3040, 1526.4], 80) / 2)
    np.testing.assert_allclose(_radii(front), front.focal * SIDEWAYS)
    assert whole[0].focal == pytest.approx(front.focal * 2880 / 3040)
    np.testing.assert_allclose(whole[0].principal, np.array([1517.5, 1520.1]) * 1440 / 3040)
    assert len(_parse(made.ONE_R).pairs((1440, 1440))) == 1  # no window is stated


def test_angles_lay_lenses_back_to_back_and_upright() -> None:
    """The sensors of a ONE R lie on their sides, a half turn apart; those of an X4 stand."""
    for text, quarter in ((made.ONE_R, 90.0), (made.X4_THIRD, 0.0)):
        pair = _parse(text).pairs((1000, 1000))[0]
        assert np.linalg.norm(_turn(pair)) < 2.0
        down = rotation_of(pair[0]).T @ [0, 1, 0]  # in the picture
        angle = np.rad2deg(np.arctan2(down[0], down[1]))
        assert abs(abs(angle) - quarter) < 1.0
    # Third angles -179.227 and 0.894 add up to 1.667 more than -180.
    turn = _turn(_parse(made.ONE_R).pairs((1000, 1000))[0])
    assert abs(turn[2]) == pytest.approx(1.667, abs=0.02)


def test_generations_agree_on_one_camera() -> None:
    """What the others give differs from the third by less than they say of themselves."""
    third = _parse(made.X4_THIRD, **X4_WINDOW)
    assert third.generation == 3
    true = third.pairs((1920, 1920))[0]
    for text, generation in ((X4_FIRST, 1), (X4_SECOND, 2), (SIXTH, 6)):
        found = _parse(text, **X4_WINDOW)
        assert found.generation == generation
        for lens, other in zip(true, found.pairs((1920, 1920))[0], strict=True):
            known = max(found.direction_sigma, third.direction_sigma)
            off = (_radii(other) - _radii(lens)) / lens.focal
            assert np.sqrt(np.mean(off**2)) < known and abs(off).max() < 2 * known
            assert np.hypot(*np.subtract(lens.principal, other.principal)) / lens.focal < known
            assert abs(other.focal / lens.focal - 1) < 1.3 * FOCAL_SIGMAS[generation]


def test_the_third_generation_is_the_unified_model() -> None:
    """Radii of xi, f and k1 to k3 by hand."""
    lens = _parse(made.X4_THIRD).pairs((8000, 6000))[0][0]
    u = np.sin(SIDEWAYS) / (np.cos(SIDEWAYS) + 1.94817)
    by_hand = 4623.605 * u * (1 + 0.38634348 * u**2 + 1.30296624 * u**4 - 3.93261027 * u**6)
    np.testing.assert_allclose(_radii(lens), by_hand, rtol=1e-3)
    np.testing.assert_allclose(lens.principal, (3987.5, 3012.7))


def test_tracks_in_the_other_order() -> None:
    usual, swapped = (
        _parse(made.ONE_R, back_first=first).pairs((1000, 1000))[0] for first in (False, True)
    )
    assert (swapped[0].focal, swapped[1].focal) == (usual[1].focal, usual[0].focal)
    assert swapped[0].principal == usual[1].principal
    for pair in (usual, swapped):
        assert rotation_of(pair[0])[2, 2] > 0.99 and rotation_of(pair[1])[2, 2] < -0.99


def test_angles_of_no_known_form_are_not_used() -> None:
    """In radians, or of lenses that do not lie back to back."""
    for front, back in (("-3.128", "0.0156"), ("30.0", "20.0")):
        text = made.ONE_R.replace("-179.227", front).replace("0.894", back)
        found = _parse(text)
        assert not found.angles_known
        np.testing.assert_allclose(_turn(found.pairs((1000, 1000))[0]), 0, atol=1e-9)


def test_a_picture_of_another_shape_shows_the_middle() -> None:
    """A sensor of 4:3 in square pictures."""
    lens = _parse(made.X4_THIRD).pairs((1920, 1920))[0][0]
    np.testing.assert_allclose(lens.principal, ((3987.5 - 1000) * 0.32, 3012.7 * 0.32))
    shifted = _parse(made.X4_THIRD, **X4_WINDOW, shift=(10, -20)).pairs((1920, 1920))[0][0]
    np.testing.assert_allclose(shifted.principal, ((3987.5 - 1130) / 3, (3012.7 - 100) / 3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "could not convert|no form"),
        ("2_1_2_3", "form is not known"),
        (made.ONE_R.replace("2_", "1_", 1), "form is not known"),
        (made.ONE_R.replace("1480.5", "nan"), "form is not known"),
        (made.ONE_R.replace("1480.5", "1e300"), "form is not known"),
        (made.ONE_R.replace("1480.5", "-5"), "folds over"),
        (made.ONE_R.replace("1517.5", "15"), "the centre of lens 1 is far from the middle"),
        (made.ONE_R.replace("4553.1", "1517.5"), "the centre of lens 2 is far from the middle"),
        (made.ONE_R.replace("6080", "0"), "canvas cannot be 0x3040"),
        (made.X4_THIRD.replace("1.94817", "0.1"), "xi 0.1"),
        (made.X4_THIRD.replace("4623.81", "0").replace("4623.4", "0"), "folds over"),
    ],
)
def test_others_are_refused_in_one_line(text: str, said: str) -> None:
    assert "Insta360 X4" in refused(said, _parse, text, camera="Insta360 X4")


def test_any_numbers_are_lenses_or_refused() -> None:
    rng = np.random.default_rng(3)
    for text in (made.ONE_R, X4_SECOND, made.X4_THIRD, SIXTH):
        for _ in range(150):
            parts: list[str] = list(text.split("_"))
            for place in rng.integers(0, len(parts), rng.integers(1, 4)):
                parts[place] = str(rng.choice(["0", "-1", "1e9", "inf", "x", "", "1e-300", "90"]))
            try:
                pair = _parse("_".join(parts)).pairs((100, 100))[0]
            except GsbaError:
                continue
            for lens in pair:
                values = [lens.focal, *lens.principal, *lens.radial, *lens.rotation]
                assert np.isfinite(values).all() and lens.focal > 0
