"""Keypoints: what every extractor promises, and what becomes of them on the rig."""

from collections.abc import Callable

import numpy as np
import pytest
from pixels import pixel_centres

from gsba.camera.rig import CubeRig, owner_faces
from gsba.camera.sphere import bearings_from_erp
from gsba.config import FeatureSettings
from gsba.features import detection
from gsba.features.detection import Extractor, FaceKeypoints, SiftExtractor
from gsba.frames import cubemap
from gsba.types import Features

SIZE = 256
RIG = CubeRig(SIZE, np.deg2rad(96))
EXTRACTORS: dict[str, Callable[[], Extractor]] = {"sift": lambda: SiftExtractor(FeatureSettings())}
extractors = pytest.mark.parametrize("make", EXTRACTORS.values(), ids=list(EXTRACTORS))


def _blobs(centres: np.ndarray, size: int = SIZE, spread: float = 3.0) -> np.ndarray:
    """Bright Gaussians on grey, (size, size, 3) uint8, at pixels (N, 2) with corner origin."""
    at = np.arange(size) + 0.5
    u, v = np.exp(-((at - centres[:, :, None]) ** 2) / (2 * spread**2)).swapaxes(0, 1)
    image = 40 + 180 * np.einsum("nv,nu->vu", v, u)
    return np.repeat(np.rint(image)[..., None], 3, axis=-1).astype(np.uint8)


def _noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Texture with detail at several scales, uint8."""
    fine = rng.integers(0, 256, shape).astype(np.float32)
    coarse = np.kron(rng.integers(0, 256, [n // 8 for n in shape[:2]]), np.ones((8, 8)))
    return (0.4 * fine + 0.6 * coarse[..., None]).astype(np.uint8)


@extractors
def test_contract_shapes_ranges_and_repeatability(make: Callable[[], Extractor]) -> None:
    image = _noise(np.random.default_rng(0), SIZE, SIZE, 3)
    found, again = make()(image, None), make()(image, None)
    num = len(found.pixels)
    assert num > 50
    assert found.pixels.shape == (num, 2) and found.pixels.dtype == np.float64
    assert (found.pixels >= 0).all() and (found.pixels <= SIZE).all()
    assert found.sigmas_px.shape == (num,)
    assert np.isfinite(found.sigmas_px).all() and (found.sigmas_px > 0).all()
    assert found.descriptors.ndim == 2 and len(found.descriptors) == num
    np.testing.assert_array_equal(found.pixels, again.pixels)
    np.testing.assert_array_equal(found.descriptors, again.descriptors)


@extractors
def test_contract_descriptors_share_one_length(make: Callable[[], Extractor]) -> None:
    found = make()(_noise(np.random.default_rng(1), SIZE, SIZE, 3), None)
    lengths = np.linalg.norm(found.descriptors.astype(float), axis=1)
    np.testing.assert_allclose(lengths, np.median(lengths), rtol=0.02)  # uint8 rounding


@extractors
def test_contract_keypoints_lie_where_the_image_has_them(make: Callable[[], Extractor]) -> None:
    cells = np.stack(np.meshgrid(np.arange(5), np.arange(5)), axis=-1).reshape(-1, 2)
    centres = 36 + 45 * cells + np.random.default_rng(2).uniform(-0.5, 0.5, (25, 2))
    found = make()(_blobs(centres), None)
    distances = np.linalg.norm(found.pixels[:, None] - centres, axis=2)
    nearest = distances.argmin(axis=0)
    assert distances.min(axis=0).max() < 0.3  # half a pixel would betray a wrong origin
    offsets = found.pixels[nearest] - centres
    assert np.abs(offsets.mean(axis=0)).max() < 0.05


@extractors
def test_contract_masked_pixels_give_nothing(make: Callable[[], Extractor]) -> None:
    image = _noise(np.random.default_rng(3), SIZE, SIZE, 3)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, : SIZE // 2] = True
    found = make()(image, mask)
    assert len(found.pixels) > 20
    assert (found.pixels[:, 0] <= SIZE // 2 + 1).all()  # rounded to the nearest mask pixel


@extractors
def test_contract_a_flat_image_gives_nothing_of_the_usual_kind(
    make: Callable[[], Extractor],
) -> None:
    usual = make()(_noise(np.random.default_rng(4), SIZE, SIZE, 3), None)
    none = make()(np.full((SIZE, SIZE, 3), 128, np.uint8), None)
    assert none.pixels.shape == (0, 2) and none.sigmas_px.shape == (0,)
    assert none.descriptors.shape == (0, usual.descriptors.shape[1])
    assert none.descriptors.dtype == usual.descriptors.dtype


def test_sift_keeps_the_strongest() -> None:
    image = _noise(np.random.default_rng(5), SIZE, SIZE, 3)
    found = SiftExtractor(FeatureSettings(max_per_face=40))(image, None)
    assert 30 <= len(found.pixels) <= 50  # orientations of one place count one by one


def test_sift_trusts_large_keypoints_less() -> None:
    settings = FeatureSettings()
    sigmas = [
        SiftExtractor(settings)(_blobs(np.array([[128.3, 127.6]]), spread=spread), None).sigmas_px
        for spread in (2.0, 8.0)
    ]
    assert detection.SIGMA_PX < sigmas[0].min() < sigmas[1].max()


def _extract(faces: np.ndarray, masks: np.ndarray | None = None) -> Features:
    return detection.extract(faces, masks, RIG, SiftExtractor(FeatureSettings()))


@pytest.fixture(scope="module")
def textured() -> tuple[np.ndarray, Features]:
    faces = cubemap.cut(_noise(np.random.default_rng(6), 512, 1024, 3), RIG)
    return faces, _extract(faces)


def test_keypoints_stay_in_the_face_that_owns_them(textured: tuple) -> None:
    _, found = textured
    assert set(found.faces) == set(range(6))
    np.testing.assert_array_equal(owner_faces(found.bearings_rig), found.faces)
    np.testing.assert_allclose(found.bearings_rig, RIG.bearings(found.pixels, found.faces))
    np.testing.assert_allclose(np.linalg.norm(found.bearings_rig, axis=1), 1)


def test_keypoints_carry_the_colour_below_them(textured: tuple) -> None:
    faces, found = textured
    columns, rows = np.floor(found.pixels).astype(int).T
    np.testing.assert_array_equal(found.colors, faces[found.faces, rows, columns])


def test_sigmas_follow_the_area_that_a_pixel_covers() -> None:
    """Isotropic noise in pixels becomes noise on the sphere whose area is the pixel's."""
    spots = np.array([[128.0, 128.0], [30.0, 60.0], [200.0, 10.0]])

    def stub(image: np.ndarray, mask: np.ndarray | None) -> FaceKeypoints:
        return FaceKeypoints(spots, np.full(3, 0.5), np.zeros((3, 4), np.float32))

    found = detection.extract(np.zeros((6, SIZE, SIZE, 3), np.uint8), None, RIG, stub)
    h = 1e-4
    shifted = [RIG.bearings(found.pixels + h * np.eye(2)[[axis]], found.faces) for axis in (0, 1)]
    du, dv = ((bearings - found.bearings_rig) / h for bearings in shifted)
    areas = np.linalg.norm(np.cross(du, dv), axis=1)  # steradians of a pixel
    np.testing.assert_allclose(found.sigmas_rad, 0.5 * np.sqrt(areas), rtol=1e-5)  # of order h


def test_masks_reach_every_face() -> None:
    panorama = _noise(np.random.default_rng(7), 512, 1024, 3)
    centres = pixel_centres(1024, 512)
    used = bearings_from_erp(centres, 1024, 512)[..., 1] < 0.2  # nothing below the horizon
    found = _extract(cubemap.cut(panorama, RIG), cubemap.cut_mask(used, RIG))
    assert len(found) > 200
    pixel = RIG.hfov_rad / SIZE
    assert (found.bearings_rig[:, 1] < 0.2 + 2 * pixel).all()
    unmasked = _extract(cubemap.cut(panorama, RIG))
    assert (unmasked.bearings_rig[:, 1] > 0.5).any()


@pytest.mark.parametrize("masked", [False, True])
def test_nothing_to_see_is_no_error(masked: bool) -> None:
    if masked:  # textured, but not to be used
        faces = _noise(np.random.default_rng(8), SIZE, 6 * SIZE, 3).reshape(6, SIZE, SIZE, 3)
        found = _extract(faces, np.zeros((6, SIZE, SIZE), bool))
    else:
        found = _extract(np.full((6, SIZE, SIZE, 3), 90, np.uint8))
    assert len(found) == 0
    assert found.pixels.shape == (0, 2) and found.bearings_rig.shape == (0, 3)
    assert found.colors.shape == (0, 3) and found.descriptors.ndim == 2


def test_a_masked_face_is_left_out_and_others_stay(textured: tuple) -> None:
    faces, found = textured
    masks = np.ones((6, SIZE, SIZE), bool)
    masks[4] = False
    rest = _extract(faces, masks)
    np.testing.assert_array_equal(rest.pixels, found.pixels[found.faces != 4])


def test_gather_lines_frames_up(textured: tuple) -> None:
    _, found = textured
    nothing = _extract(np.full((6, SIZE, SIZE, 3), 90, np.uint8))
    together = detection.gather([found, nothing, found])
    num = len(found)
    np.testing.assert_array_equal(together.starts, [0, num, num, 2 * num])
    np.testing.assert_array_equal(together.bearings_of(2), found.bearings_rig)
    assert len(together.bearings_of(1)) == 0
    np.testing.assert_array_equal(together.colors[num:], found.colors)
    np.testing.assert_array_equal(together.sigmas_rad[:num], found.sigmas_rad)
