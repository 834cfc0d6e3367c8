"""Views of one lens: what they show is what a pinhole camera at that lens would."""

from functools import cache

import cv2
import numpy as np
import pytest
from one_gallery import gallery
from pixels import pixel_centres
from scipy.spatial.transform import Rotation

from gsba.camera.lens import Lenses
from gsba.camera.pictures import Picture, lens_picture, panorama
from gsba.camera.sphere import erp_directions, erp_from_bearings
from gsba.camera.views import View, ViewCutter, lens_views
from gsba.demo.render import render_erp
from gsba.demo.walk import walk_poses
from gsba.geometry import pose
from gsba.types import Fisheye

WIDTH, SIZE = 1024, 160
SHAPE = WIDTH, WIDTH // 2
AXES = Rotation.from_rotvec([[0.2, -0.3, 0.1]]).as_matrix()
TURNED = Lenses(np.array([0.0, 0.01, 0.06]), band_rad=np.deg2rad(4), axes=AXES)
RIG = walk_poses("rectangle", "locked", 20, 0).world_T_rigs[4]
VIEWS = {view.name: view for view in lens_views(TURNED, SIZE)}


def _render(world_T_camera: np.ndarray) -> np.ndarray:
    return np.asarray(render_erp(gallery(), world_T_camera, *SHAPE), np.float32)


def _lens(view: View) -> np.ndarray:
    """Pose of a view in the world."""
    world_T_lenses = RIG @ pose(AXES[0], np.zeros(3))
    return world_T_lenses @ view.rig_T_view


@cache
def _panorama() -> np.ndarray:
    """Each direction as the lens that faces it has it."""
    own = erp_directions(SHAPE[0]) @ AXES[0]
    halves = []
    for sign in (1, -1):
        lens = RIG.copy()
        lens[:3, 3] += sign * RIG[:3, :3] @ AXES[0] @ TURNED.centre
        halves.append(_render(lens))
    return np.where(own[..., 2:] > 0, *halves).clip(0, 255).astype(np.uint8)


def _seen(view: View, world_T_view: np.ndarray) -> np.ndarray:
    """What a pinhole camera at a pose sees: a panorama that looks along it, about its middle."""
    flat = (pixel_centres(view.width, view.height) - view.principal) / view.focal
    rays = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1)
    at = (erp_from_bearings(rays, *SHAPE) - 0.5).astype(np.float32)
    return cv2.remap(_render(world_T_view), at[..., 0], at[..., 1], cv2.INTER_CUBIC)


def _blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), 1.5)


@pytest.mark.parametrize(
    "name", ["front", "back", "left_front", "up_front", "right_back", "down_back"]
)
def test_a_view_is_what_its_lens_sees(name: str) -> None:
    view = VIEWS[name]
    (found,) = ViewCutter((view,), TURNED, 0).cut([panorama(_panorama(), view.focal)])
    middle = _lens(view)
    middle[:3, 3] = RIG[:3, 3]
    exact, central = _seen(view, _lens(view)), _seen(view, middle)
    off, elsewhere = (
        float(np.abs(_blurred(found) - _blurred(other)).mean()) for other in (exact, central)
    )
    assert off < 1.0 and elsewhere > 4 * off  # of 255: interpolation aside, the same


def test_views_of_raw_lenses_are_cut_where_their_rays_lie(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = Fisheye(1500, 1500, 480.0, (748.0, 753.0), (-0.05, 0.006, -0.005, 0.001), (0.0, 0, 0))
    view, found = lens_views(TURNED, 801)[1], []

    def at(picture: Picture, places: np.ndarray, _: int) -> np.ndarray:
        found.append(places)
        return picture.image[: len(places), : places.shape[1]]

    monkeypatch.setattr(Picture, "at", at)
    picture = lens_picture(lens, np.zeros((1500, 1500), np.uint8), view.focal)
    list(ViewCutter((view,), Lenses(), 0).cut([picture]))
    exact = picture.grid.places(view.rays(pixel_centres(view.width, view.height)))
    np.testing.assert_allclose(np.concatenate(found), exact, atol=0.005)  # pixels
