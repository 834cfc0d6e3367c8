"""The gsplat backend against the CPU's, on gsplat's own PyTorch versions of its CUDA kernels.

What stands in here for CUDA are the reference functions that gsplat ships, and a dense blending of
ours, because gsplat's needs a further package. With a CUDA device the same runs on the kernels.
"""

import dataclasses
import sys
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused

from gsba.geometry import rotation_from_quaternion
from gsba.splat.backend import Backend, CpuBackend, choose_backend
from gsba.splat.camera import FaceCamera
from gsba.splat.gaussians import Gaussians
from gsba.splat.options import TrainingOptions
from gsba.splat.train import Trainer, Views, begin

torch = pytest.importorskip("torch", reason="torch is not installed: pip install '.[splat]'")
rendering = pytest.importorskip("gsplat.rendering", reason="gsplat is not installed")
reference = pytest.importorskip("gsplat.cuda._torch_impl")

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
NEAR, SIZE = 0.05, 32


def _project(means, _covars, quats, scales, viewmats, Ks, width, height, **options):
    assert not options.pop("packed") and not options.pop("sparse_grad")
    assert options.pop("radius_clip") == 0 and options.pop("opacities") is not None
    covars, _ = reference._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    return reference._fully_fused_projection(means, covars, viewmats, Ks, width, height, **options)


def _blend(means2d, conics, colors, opacities, width, height, *_tiles, **_options):
    """All Gaussians at all pixels of each image, near ones first."""
    images, alphas = [], []
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    for c in range(len(means2d)):
        image, through = torch.zeros(height, width, colors.shape[-1]), torch.ones(height, width)
        for g in _blend.order[c]:
            du, dv = u + 0.5 - means2d[c, g, 0], v + 0.5 - means2d[c, g, 1]
            a, b, d = conics[c, g]
            alpha = opacities[c, g] * torch.exp(-0.5 * (a * du**2 + d * dv**2) - b * du * dv)
            alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros(()))
            image = image + (alpha * through)[..., None] * colors[c, g]
            through = through * (1 - alpha)
        images.append(image)
        alphas.append(1 - through[..., None])
    return torch.stack(images), torch.stack(alphas)


def _tiles(_means2d, radii, depths, *_sizes, **_options):
    """Only the order in depth of what is seen matters to `_blend`."""
    seen = (radii > 0).all(dim=-1)
    _blend.order = [
        [int(g) for g in torch.argsort(depths[c]) if seen[c, g]] for c in range(len(depths))
    ]
    return None, None, None


@pytest.fixture
def backend(monkeypatch: pytest.MonkeyPatch) -> Backend:
    from gsba.splat.gpu import GsplatBackend

    if DEVICE == "cpu":
        stand_ins: dict[str, Callable] = {
            "fully_fused_projection": _project,
            "spherical_harmonics": lambda degree, dirs, shs, masks: reference._spherical_harmonics(
                degree, dirs, shs
            ),
            "isect_tiles": _tiles,
            "isect_offset_encode": lambda _ids, num, wide, high: torch.zeros(num * wide * high),
            "rasterize_to_pixels": _blend,
        }
        for name, function in stand_ins.items():
            monkeypatch.setattr(rendering, name, function)
    return GsplatBackend(DEVICE)


def _gaussians(num: int, seed: int) -> Gaussians:
    """Blobs around the origin, none of them opaque: gsplat lets 0.999 of alpha pass, we 0.99."""
    draw = np.random.default_rng(seed)
    arrays = (
        draw.uniform(-1, 1, (num, 3)),
        draw.uniform(np.log(0.05), np.log(0.3), (num, 3)),
        draw.normal(0, 1, (num, 4)),
        draw.uniform(-2, 2, num),
        draw.normal(0, 0.3, (num, 9, 3)),
    )
    return Gaussians(*(array.astype(np.float32) for array in arrays))


def _cameras(num: int) -> list[FaceCamera]:
    """Around the blobs, looking at them, none with a Gaussian near its own plane; of two shapes."""
    draw = np.random.default_rng(5)
    cameras = []
    for c, quaternion in enumerate(draw.normal(0, 1, (num, 4))):
        turn = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion))
        place, height = turn @ np.array([0.1, 0.2, -3.0]), SIZE - 10 * (c % 2)
        middle = (0.5 * SIZE, 0.5 * height)
        cameras.append(FaceCamera(turn, place, SIZE, height, 0.5 * SIZE, middle))
    return cameras


@pytest.mark.parametrize("degree", [0, 1, None])
def test_renderings_are_those_of_the_cpu(backend: Backend, degree: int | None) -> None:
    splat, cameras = _gaussians(40, 1), _cameras(3)
    ours = CpuBackend(1).render(splat, cameras, degree, NEAR)
    theirs = backend.render(splat, cameras, degree, NEAR)
    assert len(theirs) == 3
    for one, other in zip(ours, theirs, strict=True):
        assert one.alpha.max() > 0.5
        np.testing.assert_allclose(other.color, one.color, atol=2e-3)
        np.testing.assert_allclose(other.alpha, one.alpha, atol=2e-3)
        sure = one.alpha > 0.1
        np.testing.assert_allclose(other.depth[sure], one.depth[sure], rtol=5e-3)


def _views(splat: Gaussians, masked: bool) -> Views:
    cameras = _cameras(6)
    found = CpuBackend(1).render(splat, cameras, None, NEAR)
    images = [np.clip(255 * image.color, 0, 255).astype(np.uint8) for image in found]
    use = [np.ones(image.shape[:2], bool) for image in images]
    for one in use:
        one[20:, :10] = not masked
    return Views(cameras, images, use if masked else None, np.zeros(6, int))


@pytest.mark.parametrize("masked", [False, True])
def test_a_stretch_of_training_is_that_of_the_cpu(
    backend: Backend, masked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsba.splat.train._NEAR", NEAR / 3.5)
    views = _views(_gaussians(40, 1), masked)
    settings = TrainingOptions(iterations=3000, sh_degree=2, seed=2)
    ends = []
    for renderer in (CpuBackend(1), backend):
        trainer, state = Trainer(views, settings, renderer), begin(_gaussians(30, 7), settings)
        while state.step < 12:
            state = trainer.advance(state, 12)
        ends.append(state)
    ours, theirs = ends
    start = _gaussians(30, 7)
    for one, other, first in zip(
        ours.gaussians.arrays(), theirs.gaussians.arrays(), start.arrays(), strict=True
    ):
        moved = np.abs(one - first)
        assert moved.max() > 0
        # Adam's first steps are signs of gradients: of those that are all but zero, it is chance
        assert np.mean(np.abs(other - one) > 0.05 * moved.max()) < 0.03
    np.testing.assert_allclose(theirs.pull.counts, ours.pull.counts)
    np.testing.assert_allclose(theirs.pull.sums, ours.pull.sums, rtol=0.05, atol=1e-4)


def test_density_control_is_at_its_time(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsba.splat.density._DENSIFY_PULL", 1e-6)
    views = _views(_gaussians(20, 1), False)
    settings = TrainingOptions(iterations=3000, sh_degree=1, seed=2)
    trainer = Trainer(views, settings, backend)
    state = dataclasses.replace(begin(_gaussians(12, 7), settings), step=140)
    before = trainer.advance(state, 3000)
    assert before.step == 150 and len(before.gaussians) > 12 and not before.pull.counts.any()
    after = trainer.advance(before, 160)
    assert after.step == 160 and after.pull.counts.any() and after.gaussians.is_finite()


def test_harmonics_that_are_not_there_are_not_asked_for(backend: Backend) -> None:
    settings, plain = TrainingOptions(iterations=3000, sh_degree=3, seed=2), _gaussians(12, 7)
    first = begin(dataclasses.replace(plain, sh=plain.sh[:, :1].copy()), settings)
    trainer = Trainer(_views(_gaussians(20, 1), False), settings, backend)
    after = trainer.advance(dataclasses.replace(first, step=140), 142)
    assert after.gaussians.is_finite() and not np.array_equal(after.gaussians.sh, plain.sh[:, :1])


@pytest.mark.parametrize("device", [False, True])
def test_what_is_missing_is_one_line(monkeypatch: pytest.MonkeyPatch, device: bool) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: device)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=None))
    reason = "finds no CUDA toolkit .* or use --backend cpu" if device else "needs a CUDA device"
    refused(reason, choose_backend, "gsplat")
    assert choose_backend("auto").name == "cpu"


def test_too_little_memory_is_one_line(backend: Backend, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_arguments: object, **_options: object) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")

    monkeypatch.setattr(backend, "_rasterize", full)
    refused("too small for 5 Gaussians", backend.render, _gaussians(5, 1), _cameras(1), None, NEAR)
    settings = TrainingOptions(iterations=100)
    trainer = Trainer(_views(_gaussians(5, 1), False), settings, backend)
    refused("too small for 4 Gaussians", trainer.advance, begin(_gaussians(4, 1), settings), 100)
