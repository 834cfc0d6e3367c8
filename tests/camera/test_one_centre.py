"""Panoramas of two lenses, stitched at the depth of things: as one camera would have them."""

from dataclasses import replace

import numpy as np
import pytest
from pixels import pixel_centres
from scipy.spatial.transform import Rotation
from synthetic import unit
from two_fisheyes import colours, made_pair, turned

from gsba.camera.fisheye import Pair, rotation_of, unproject
from gsba.camera.lens import Lenses, rows_run
from gsba.camera.one_centre import Stitcher
from gsba.camera.pictures import lens_picture, panorama
from gsba.camera.rig import RIG_R_FACE, owner_faces
from gsba.camera.sphere import erp_directions
from gsba.camera.views import depths_along
from gsba.types import Fisheye

WIDTH = 512
MIDDLE, RADIUS = np.array([0.2, -0.1, 0.15]), 1.0  # of the ball that everything is on
CENTRE = np.array([0.0005, -0.001, 0.012])
AXES = Rotation.from_rotvec([[0.2, -0.3, 0.1]]).as_matrix()
TWIST = np.array([[0.01, -0.02, 0.015, 0.03, 0.02, -0.04]])
STITCHED = {
    "two centres": Lenses(CENTRE, band_rad=np.deg2rad(3)),
    "turned below the panorama": Lenses(CENTRE, band_rad=np.deg2rad(3), axes=AXES),
    "stitched for a radius": Lenses(CENTRE, inverse_stitch_radius=0.5, band_rad=np.deg2rad(3)),
}


def _hit(starts: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Where rays (..., 3) from starts (..., 3) inside the ball meet it."""
    away = starts - MIDDLE
    along = np.sum(away * rays, axis=-1)
    length = np.sqrt(along**2 + RADIUS**2 - np.sum(away**2, axis=-1)) - along
    return starts + length[..., None] * rays


def _seen(starts: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """RGB (..., 3) of what is on the ball, painted by its direction from the rig's centre."""
    return colours(unit(_hit(starts, rays)))


def _scene(num: int = 3000) -> np.ndarray:
    """Points (N, 3) of the ball, rig frame."""
    rays = unit(np.random.default_rng(0).normal(size=(num, 3)))
    return _hit(np.zeros_like(rays), rays)


def _stitched(lenses: Lenses) -> np.ndarray:
    """What a stitcher makes of it, (H, 2 H, 3) uint8: both lenses as shown, blended at the seam."""
    shown, nowhere = erp_directions(WIDTH).reshape(-1, 3), np.zeros(WIDTH * WIDTH // 2, int)
    along = lenses.own(shown, nowhere)[:, 2]
    ahead = np.clip(0.5 + np.arcsin(along) / (2 * lenses.band_rad), 0, 1)[:, None]
    image = 0.0
    for lens, share in ((0, ahead), (1, 1 - ahead)):
        starts = lenses.origins(shown, nowhere, np.full(len(shown), lens))
        image = image + share * _seen(starts, unit(shown - lenses.inverse_stitch_radius * starts))
    return np.rint(image).astype(np.uint8).reshape(WIDTH // 2, WIDTH, 3)


def _off(found: np.ndarray, near_seam: np.ndarray) -> tuple[float, float]:
    """Mean differences of grey values from one camera's panorama, at the seam and elsewhere."""
    off = np.abs(found - colours(erp_directions(WIDTH))).mean(axis=-1)
    return float(off[near_seam].mean()), float(off[~near_seam].mean())


@pytest.mark.parametrize("lenses", STITCHED.values(), ids=STITCHED)
def test_a_stitched_panorama_becomes_one_cameras(lenses: Lenses) -> None:
    given = _stitched(lenses)
    nowhere = np.zeros(given[..., 0].size, int)
    along = lenses.own(erp_directions(WIDTH).reshape(-1, 3), nowhere)[:, 2].reshape(given.shape[:2])
    seam = np.abs(along) < np.sin(np.deg2rad(5))
    found = _off(Stitcher(lenses, 0, _scene()).stitched([panorama(given)], WIDTH), seam)
    before = _off(given, seam)
    assert found[1] < 0.4 and before[1] > 3 * found[1]  # rounding alone makes .25
    assert found[0] < 0.6 and before[0] > 2.5 * found[0]


def _picture(lens: Fisheye, sign: float, way: float) -> np.ndarray:
    """What a lens sees while the rig moves, (h, w, 3) uint8."""
    pixels = pixel_centres(lens.width, lens.height)
    rays = unproject(lens, pixels)
    moved = (way * (pixels[..., 1] / lens.height - 0.5))[..., None] * TWIST[0]
    turns = Rotation.from_rotvec(moved[..., :3].reshape(-1, 3))
    starts = turns.apply(np.tile(sign * CENTRE, (rays[..., 0].size, 1))) + moved[..., 3:].reshape(
        -1, 3
    )
    seen = _seen(starts.reshape(rays.shape), turns.apply(rays.reshape(-1, 3)).reshape(rays.shape))
    ahead = rays @ rotation_of(lens)[:, 2] > np.cos(np.deg2rad(100))
    return np.where(ahead[..., None], np.rint(seen), 0).astype(np.uint8)


def _raw(pair: Pair, ways: tuple[float, float]) -> tuple[Lenses, list[np.ndarray]]:
    row_directions = np.array(ways)[:, None] * rows_run(pair)
    lenses = Lenses(
        CENTRE,
        band_rad=0.02,
        row_directions=row_directions,
        readout_motion=TWIST,
        reference_calibration=pair,
    )
    lenses_of = zip(pair, (1.0, -1.0), ways, strict=True)
    return lenses, [_picture(lens, sign, way) for lens, sign, way in lenses_of]


@pytest.mark.parametrize("ways", [(1.0, 1.0), (1.0, -1.0)])
def test_raw_pictures_become_one_cameras_at_one_instant(ways: tuple[float, float]) -> None:
    pair = made_pair(400)
    lenses, images = _raw(pair, ways)
    pictures = list(map(lens_picture, pair, images))
    seam = np.abs(erp_directions(WIDTH)[..., 2]) < np.sin(np.deg2rad(5))
    found = _off(Stitcher(lenses, 0, _scene()).stitched(pictures, WIDTH), seam)
    assert max(found) < 0.6
    still = replace(lenses, readout_motion=None)
    for wrong, scene in ((lenses, np.zeros((0, 3))), (still, _scene())):
        other = _off(Stitcher(wrong, 0, scene).stitched(pictures, WIDTH), seam)
        assert min(other) > 3 * max(found)


def test_lenses_that_look_up_and_down_show_nothing_at_the_other_pole() -> None:
    """Of panoramas with more rows than are stitched at once."""
    lens = Fisheye(80, 80, 25.0, (40.0, 40.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    rig = tuple(turned(lens, rig_R_face) for rig_R_face in RIG_R_FACE)
    greys = [40 * face + 20 for face in range(6)]
    pictures = [
        lens_picture(one, np.full((80, 80, 3), grey, np.uint8))
        for one, grey in zip(rig, greys, strict=True)
    ]
    found = Stitcher(Lenses.of_raw(rig), 0, np.zeros((0, 3))).stitched(pictures, 1024)
    faced = owner_faces(erp_directions(1024))
    assert np.mean(found[..., 0] == np.array(greys)[faced]) > 0.99


def test_masks_move_along() -> None:
    lenses = Lenses(3 * CENTRE, band_rad=np.deg2rad(3))
    stitcher, rays = Stitcher(lenses, 0, _scene()), erp_directions(WIDTH)
    spot = unit(np.array([1.0, 0.1, 0.5]))
    shown = unit(lenses.seeing(_hit(np.zeros(3), spot)[None], np.zeros(1, int)))[0]
    used = rays @ shown < np.cos(np.deg2rad(6))
    found = stitcher.stitched_mask(used)
    middle = unit(rays[~found].mean(axis=0))  # pixels are .7 degrees wide
    assert np.degrees(np.arccos(middle @ spot)) < 0.35 < 1 < np.degrees(np.arccos(shown @ spot))
    assert stitcher.stitched_mask(np.ones_like(used)).all()


def test_depths_are_those_of_planes_to_their_edges() -> None:
    rng = np.random.default_rng(0)
    normals = np.array([[0.3, 0.1, 0.4], [-0.9, 0.3, 0.6]])  # 1 / distance of planes at their foot

    def depth(directions: np.ndarray) -> np.ndarray:
        return 1 / np.maximum(*(directions @ normals.T).T)  # the nearer one hides the other

    rays = unit(rng.normal(size=(3000, 3)) * 0.5 + [0, 0, 1.0])
    rays = rays[np.max(rays @ normals.T, axis=1) > 0.1]
    asked = unit(rng.normal(size=(400, 3)) * 0.2 + [0, 0, 1.0])
    edge = np.abs(asked @ (normals[0] - normals[1])) < 0.1
    points = depth(rays)[:, None] * rays
    points[::10] *= rng.uniform(0.5, 2, (len(points[::10]), 1))  # wrong ones
    off = np.abs(depths_along(asked, points) / depth(asked) - 1)
    assert np.median(off[~edge]) < 0.006 and np.median(off[edge]) < 0.008
    assert np.percentile(off[~edge], 95) < 0.03
    np.testing.assert_allclose(depths_along(asked, 3 * rays[:2]), 3.0)
