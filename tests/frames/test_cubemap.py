"""Faces cut from panoramas, against a smooth picture known on the whole sphere."""

import numpy as np
import pytest
from pixels import pixel_centres

from gsba.camera.rig import CubeRig
from gsba.camera.sphere import erp_directions
from gsba.config import CubemapSettings
from gsba.frames import cubemap
from gsba.types import PictureFormat


def _picture(bearings: np.ndarray, frequency: float = 6.0) -> np.ndarray:
    """A smooth function on the sphere, (..., 3) in 0..255, without symmetry between faces."""
    x, y, z = np.moveaxis(bearings, -1, 0)
    waves = [
        np.sin(frequency * x + 0.3) * np.cos(0.8 * frequency * z),
        np.cos(frequency * y - 0.7) * np.sin(frequency * z + 1.1),
        np.sin(0.5 * frequency * (x + y) + frequency * z),
    ]
    return 127.5 + 120 * np.stack(waves, axis=-1)


def _panorama(width: int, frequency: float = 6.0) -> np.ndarray:
    bearings = erp_directions(width)
    return np.rint(_picture(bearings, frequency)).astype(np.uint8)


def _faces(rig: CubeRig, frequency: float = 6.0) -> np.ndarray:
    grid = pixel_centres(rig.size, rig.size)
    return np.stack([_picture(rig.bearings(grid, face), frequency) for face in range(6)])


@pytest.mark.parametrize("hfov_deg", [90, 96])
def test_every_face_shows_the_sphere(hfov_deg: float) -> None:
    """Bicubic sampling of so smooth a picture errs by rounding alone, at seam and poles too."""
    rig = CubeRig(160, np.deg2rad(hfov_deg))
    error = cubemap.cut(_panorama(640), rig) - _faces(rig)
    # Rounding input and output, and sampling positions rounded to 1/32 px: up to 0.5 + 0.5 + 0.3.
    assert np.abs(error).max() < 2.0
    assert np.sqrt(np.mean(error**2)) < 0.6


@pytest.mark.parametrize("face", [4, 5])
def test_poles_continue_on_their_other_side(face: int) -> None:
    """Seen through a panorama so coarse that a face's middle lies between rows at the pole."""
    rig = CubeRig(160, np.pi / 2)
    error = cubemap.cut(_panorama(32, 3.0), rig)[face] - _faces(rig, 3.0)[face]
    # Sampling errs by 5 anywhere at 3 / rad and 0.2 rad a pixel; the wrong side by 16 at the pole.
    assert np.abs(error[70:90, 70:90]).max() < 7.0


def test_nothing_is_shifted() -> None:
    """A shift by a hundredth of a pixel on any face would show in the regression on gradients."""
    rig = CubeRig(160, np.pi / 2)
    exact = _faces(rig)
    error = cubemap.cut(_panorama(640), rig) - exact
    for face in range(6):
        dv, du = np.gradient(exact[face], axis=(0, 1))
        gradients = np.column_stack([du.ravel(), dv.ravel()])
        shift = np.linalg.lstsq(gradients, error[face].ravel(), rcond=None)[0]
        assert np.abs(shift).max() < 0.01


def test_grey_panoramas_keep_their_shape() -> None:
    rig = CubeRig(160, np.deg2rad(96))
    panorama = _panorama(640)
    np.testing.assert_array_equal(
        cubemap.cut(np.ascontiguousarray(panorama[..., 0]), rig), cubemap.cut(panorama, rig)[..., 0]
    )


def test_coarse_faces_are_low_passed_and_not_shifted() -> None:
    rig = CubeRig(64, np.pi / 2)
    error = cubemap.cut(_panorama(2048), rig) - _faces(rig)
    # Averaging over a pixel of 1/32 rad lowers waves of 6 / rad by 1 - sinc = 0.15 %: 0.2 of 120;
    # the rest is rounding.
    assert np.abs(error).max() < 2.5
    noise = np.random.default_rng(0).integers(0, 256, (1024, 2048, 3), np.uint8)
    faces = cubemap.cut(noise, rig)
    # A pixel averages 8 x 8 of the panorama's: white noise falls to an eighth, no more than twice
    # that after bicubic sampling; picking single pixels would leave all of it.
    assert faces.std() < 2 / 8 * noise.std()


def test_masks_are_cut_where_they_lie() -> None:
    rig = CubeRig(160, np.deg2rad(96))
    bearings = erp_directions(640)
    centre = np.array([-0.1, 0.05, -1.0])  # a disc across the seam
    centre /= np.linalg.norm(centre)
    for axis in (centre, np.array([0.0, -1.0, 0.0])):  # and one over a pole
        masks = cubemap.cut_mask(bearings @ axis > np.cos(0.4), rig)
        angles = np.stack(
            [np.arccos(rig.bearings(pixel_centres(160, 160), face) @ axis) for face in range(6)]
        )
        pixel = 2 * np.pi / 640
        assert masks[angles < 0.4 - pixel].all()
        assert not masks[angles > 0.4 + pixel].any()


@pytest.mark.parametrize("oversampling", [0.5, 1.25])
def test_automatic_size_follows_the_panoramas_density(oversampling: float) -> None:
    settings = CubemapSettings(oversampling=oversampling, min_face_size=64, max_face_size=2048)
    rig = cubemap.rig_for(PictureFormat("erp", 2048, 1024), settings)
    assert 2 * np.pi * rig.focal == pytest.approx(oversampling * 2048, rel=0.5 / rig.size)
    assert rig.hfov_rad == pytest.approx(np.deg2rad(96))


def test_sizes_can_be_set_and_bounded() -> None:
    for width, least, most, size in ((8192, 256, 700, 700), (512, 300, 700, 300)):
        settings = CubemapSettings(min_face_size=least, max_face_size=most)
        assert cubemap.rig_for(PictureFormat("erp", width, width // 2), settings).size == size


def test_cube_frames_keep_their_own_faces_up_to_the_size_of_panoramas() -> None:
    for own, size in ((333, 333), (2048, CubemapSettings().max_face_size)):
        rig = cubemap.rig_for(PictureFormat("cube", own, own), CubemapSettings())
        assert (rig.size, rig.hfov_rad) == (size, np.pi / 2)
