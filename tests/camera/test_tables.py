"""Large tables that threads share, and panoramas padded in their own memory."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from factors.patch_windows import over_poles
from gsba.camera.lens import Lenses
from gsba.camera.pictures import panorama
from gsba.camera.rig import CubeRig
from gsba.camera.sphere import around_seam, around_sphere, table
from gsba.camera.views import ViewCutter, lens_views
from gsba.frames import cubemap


def test_threads_that_ask_at_once_have_one_table() -> None:
    together, made = threading.Barrier(4), []

    @table(maxsize=2)
    def numbers(size: int) -> list[int]:
        made.append(size)
        threading.Event().wait(0.05)  # for the others to ask meanwhile
        return list(range(size))

    def ask(_: int) -> list[int]:
        together.wait()
        return numbers(5)

    with ThreadPoolExecutor(4) as pool:
        first, *others = pool.map(ask, range(4))
    assert made == [5] and all(other is first for other in others)
    assert numbers(3) == [0, 1, 2] and numbers(5) is first


@pytest.mark.parametrize("shape", [(8, 16), (100, 200, 3), (208, 416, 3)])
def test_a_panorama_is_padded_where_it_lies(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    wanted = around_seam(over_poles(image, 4), 4)
    assert np.array_equal(around_sphere(image, 4), wanted)
    out = np.zeros_like(wanted)
    at_the_end = out.reshape(-1)[-image.size :].reshape(shape)
    at_the_end[:] = image
    assert np.array_equal(around_sphere(at_the_end, 4, out), wanted)
    out = np.zeros_like(wanted)
    out[4:-4, 4:-4] = image
    assert np.array_equal(around_sphere(out[4:-4, 4:-4], 4, out), wanted)


def test_places_are_the_same_band_by_band(monkeypatch: pytest.MonkeyPatch) -> None:
    rig, lenses = (
        CubeRig(333, np.pi / 2),
        Lenses(np.array([0.0, 0.01, 0.2]), inverse_stitch_radius=0.1),
    )
    views, scene = lens_views(lenses, 333), np.random.default_rng(1).normal(size=(50, 3))
    erp = np.random.default_rng(2).integers(0, 255, (256, 512, 3), dtype=np.uint8)
    compute = cubemap._maps.__wrapped__  # type: ignore[attr-defined]
    picture = panorama(erp, views[0].focal)
    found = compute(rig, picture.grid), list(ViewCutter(views, lenses, 0, scene).cut([picture]))
    monkeypatch.setattr("gsba.camera.sphere._BAND_ROWS", 1000)
    assert np.array_equal(compute(rig, picture.grid), found[0])
    cutter = ViewCutter(views, lenses, 0, scene)
    for part, wanted in zip(cutter.cut([picture]), found[1], strict=True):
        assert np.array_equal(part, wanted)
