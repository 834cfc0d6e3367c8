"""The CPU rasteriser against a dense one in float64, and its gradients against differences."""

import dataclasses

import dense_splat
import numpy as np
import pytest

from gsba.camera.rig import CubeRig
from gsba.camera.views import rig_views
from gsba.splat import _tiles
from gsba.splat.camera import FaceCamera, view_camera
from gsba.splat.gaussians import Gaussians
from gsba.splat.rasterise import differentiate, render

SIZE = 40  # not a multiple of the tile: the last tiles reach beyond the image


def scene(
    seed: int, num: int, pixels: float = 3.0, wide: bool = False
) -> tuple[Gaussians, FaceCamera]:
    """Gaussians in front of, around and behind a tilted face; some large, some faint.

    A wide face is one of another shape, with the principal point beside its middle.
    """
    rng = np.random.default_rng(seed)
    world_T_rig = np.eye(4)
    world_T_rig[:3, :3] = dense_splat.rotation(rng.normal(size=4))
    world_T_rig[:3, 3] = rng.normal(size=3)
    camera = view_camera(world_T_rig, rig_views(CubeRig(SIZE, np.deg2rad(90)))[1])
    if wide:
        size = {"width": SIZE + 9, "height": SIZE - 17}
        camera = dataclasses.replace(camera, **size, principal=(20.0, 13.5))
    z = rng.uniform(1, 6, num) * np.where(rng.random(num) < 0.1, -1, 1)
    local = np.column_stack([rng.uniform(-1.4, 1.4, (num, 2)) * np.abs(z)[:, None], z])
    widths = np.log(pixels / camera.focal * np.abs(z))[:, None] + rng.normal(0, 0.6, (num, 3))
    return Gaussians(
        (local @ camera.world_R_face.T + camera.face_in_world).astype(np.float32),
        widths.astype(np.float32),
        rng.normal(size=(num, 4)).astype(np.float32),
        rng.normal(0, 2.5, num).astype(np.float32),
        rng.normal(0, 0.3, (num, 16, 3)).astype(np.float32),
    ), camera


def test_exponential() -> None:
    x = np.linspace(-79, 0, 100_001, dtype=np.float32)
    error = _tiles.exp_of(x) / np.exp(x.astype(np.float64)) - 1
    assert (np.abs(error) < 1.2e-7 * (2 - x)).all()  # roundings of float32, one of the argument
    assert _tiles.exp_of(np.float32([-1e9, 0]))[1] == 1


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("degree", range(4))
def test_image_is_that_of_the_dense_reference(seed: int, degree: int) -> None:
    gaussians, camera = scene(seed, 150, wide=seed > 1)
    image, _ = render(gaussians, camera, sh_degree=degree, num_threads=2)
    ours = np.dstack([image.color, image.depth, image.alpha])
    reference = dense_splat.render(gaussians, camera, degree)
    scale = np.array([1, 1, 1, 6, 1])  # depths reach 6
    # An alpha within rounding of 1/255 may fall on either side: such a pixel is off by 1/255.
    off = np.abs(ours - reference).max(axis=2) > 1e-4 * scale.max()
    assert off.mean() < 2e-3
    assert np.abs((ours - reference) / scale)[~off].max() < 1e-4


def test_large_opaque_gaussians_fill_pixels_up() -> None:
    gaussians, camera = scene(5, 300, pixels=9)
    opaque = dataclasses.replace(gaussians, opacity_logits=np.full(300, 6, np.float32))
    reference = dense_splat.render(opaque, camera, 3)
    assert (reference[..., 4] > 0.999).mean() > 0.5  # else early termination is not at work
    image, tape = render(opaque, camera)
    assert tape.used.sum() < len(tape.owners)
    assert np.quantile(np.abs(image.color - reference[..., :3]), 0.999) < 1e-4


def test_number_of_threads_changes_nothing() -> None:
    gaussians, camera = scene(1, 5000, pixels=1)
    d_color = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    results = []
    for num_threads in (1, 3):
        image, tape = render(gaussians, camera, num_threads=num_threads)
        gradients = differentiate(tape, d_color, num_threads=num_threads)
        results.append([image.color, image.depth, *gradients.gaussians.arrays()])
    for one, other in zip(*results, strict=True):
        assert np.array_equal(one, other)


def numerical(loss, gaussians: Gaussians, name: str, picks: np.ndarray) -> np.ndarray:
    """Central differences in float64 of some entries of a parameter array."""
    base = Gaussians(*(array.astype(np.float64) for array in gaussians.arrays()))
    values = getattr(base, name)
    slopes = np.empty(len(picks))
    for i, pick in enumerate(picks):
        losses = []
        for step in (1e-6, -1e-6):
            moved = values.copy()
            moved.flat[pick] += step
            losses.append(loss(dataclasses.replace(base, **{name: moved})))
        slopes[i] = (losses[0] - losses[1]) / 2e-6
    return slopes


@pytest.mark.parametrize("name", [entry.name for entry in dataclasses.fields(Gaussians)])
@pytest.mark.parametrize("seed", [10, 11])
def test_gradients_are_those_of_the_dense_reference(seed: int, name: str) -> None:
    gaussians, camera = scene(seed, 30, pixels=4, wide=seed > 10)
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(camera.height, camera.width, 5))

    def loss(moved: Gaussians) -> float:
        return float(np.sum(weights * dense_splat.render(moved, camera, 3)))

    _, tape = render(gaussians, camera)
    d_image = weights.astype(np.float32)
    gradients = differentiate(tape, d_image[..., :3], d_image[..., 3], d_image[..., 4])
    analytic = getattr(gradients.gaussians, name)
    picks = rng.permutation(analytic.size)[:60]
    expected = numerical(loss, gaussians, name, picks)
    # A step across a threshold (alpha of 1/255) makes a difference of no meaning: a jump / 2e-6.
    smooth = np.abs(expected) < 1e3
    assert smooth.mean() > 0.9
    scale = np.abs(expected[smooth]).max()
    assert np.abs(analytic.flat[picks] - expected)[smooth].max() < 1e-4 * scale


@pytest.mark.parametrize("off", [-1, 1])
def test_a_border_that_two_kernels_round_apart_does_no_harm(off: int) -> None:
    """The last splat touches one tile more or less than was counted: no list is overrun."""
    gaussians, camera = scene(3, 60, 6.0)
    tape, across = render(gaussians, camera)[1], -(-SIZE // _tiles.TILE)
    seen = np.flatnonzero(tape.reach2)
    order = seen[np.argsort(tape.splats[seen, 9], kind="stable")]
    last = int(np.flatnonzero(np.diff(tape.offsets) > 1)[-1])
    offsets = tape.offsets.copy()
    offsets[last + 1 :] += off
    num = int(offsets[-1])
    owners, entries = np.full(num + 8, -7, np.int32), np.full(num + 8, -7, np.int64)
    starts = np.empty(across * across + 1, np.int64)
    _tiles.fill_tiles(
        tape.splats, tape.reach2, order, offsets, across, across, starts, owners[:num],
        entries[:num],
    )  # fmt: skip
    rows = int(starts[-1])
    assert rows == num - max(off, 0)
    assert (owners[rows:] == -7).all() and (entries[rows:] == -7).all()
    spare = {int(offsets[last + 1]) - 1} if off > 0 else set()
    assert set(entries[:rows].tolist()) == set(range(num)) - spare


def test_nothing_in_sight_is_black() -> None:
    gaussians, camera = scene(0, 10)
    behind = camera.face_in_world - 5 * camera.world_R_face[:, 2]
    gone = dataclasses.replace(gaussians, means=np.tile(behind, (10, 1)).astype(np.float32))
    image, tape = render(gone, camera)
    assert not image.color.any() and not image.alpha.any() and not image.depth.any()
    gradients = differentiate(tape, np.ones((SIZE, SIZE, 3)))
    assert not gradients.seen.any() and not gradients.gaussians.means.any()
