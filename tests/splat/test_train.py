"""Training: density control, Adam, and a small splat that is found again from its images."""

import dataclasses
import logging
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from gsba.camera.rig import CubeRig
from gsba.camera.views import rig_views
from gsba.geometry import pose
from gsba.log import GsbaError
from gsba.splat import adam
from gsba.splat.backend import CpuBackend, Lesson, choose_backend
from gsba.splat.camera import view_camera
from gsba.splat.density import Pull, densify, reset_opacity
from gsba.splat.gaussians import Gaussians, from_cloud
from gsba.splat.metrics import psnr
from gsba.splat.options import TrainingOptions
from gsba.splat.rasterise import render
from gsba.splat.train import Views, advance, begin, extent_of, most_gaussians, times_for, train

SIZE = 32
RIG = CubeRig(SIZE, np.pi / 2)
SETTINGS = TrainingOptions(iterations=320, face_size=SIZE, sh_degree=1, seed=3)
BACKEND = CpuBackend(1)
LIMITS = 10.0, 1000, True  # extent, most Gaussians, huge ones are pruned


def scene() -> tuple[Gaussians, Views]:
    """Coloured blobs on a wall, and views of it from a row of places."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2, 2, (150, 2)), rng.uniform(1.8, 2.2, 150)])
    truth = from_cloud(points, rng.integers(0, 256, (150, 3)).astype(np.uint8), 1)
    truth = dataclasses.replace(truth, opacity_logits=np.full(150, 3, np.float32))
    places = np.column_stack([np.linspace(-0.5, 0.5, 6), np.zeros(6), np.linspace(0, 0.3, 6)])
    cameras = [view_camera(pose(np.eye(3), place), rig_views(RIG)[0]) for place in places]
    images = [render(truth, camera)[0].color for camera in cameras]
    return truth, Views(
        cameras, (np.clip(images, 0, 1) * 255 + 0.5).astype(np.uint8), None, np.arange(6)
    )


def start(truth: Gaussians) -> Gaussians:
    """Where a cloud with noise and no colour would start."""
    rng = np.random.default_rng(1)
    points = truth.means + rng.normal(0, 0.03, truth.means.shape)
    return from_cloud(points, np.full((len(truth), 3), 128, np.uint8), 1)


@pytest.fixture(scope="module")
def views() -> Views:
    return scene()[1]


@pytest.fixture(scope="module")
def cloud() -> Gaussians:
    return start(scene()[0])


@pytest.fixture(scope="module")
def trained(cloud: Gaussians, views: Views) -> Gaussians:
    """The splat after a whole training."""
    return train(cloud, views, SETTINGS, BACKEND)


def quality(splat: Gaussians, views: Views) -> float:
    found = [render(splat, camera)[0].color for camera in views.cameras]
    return psnr(np.clip(found, 0, 1), np.asarray(views.images) / 255)


def same(one: Gaussians, other: Gaussians) -> bool:
    pairs = zip(one.arrays(), other.arrays(), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def test_images_are_learned_the_same_way_every_time(
    cloud: Gaussians, views: Views, trained: Gaussians
) -> None:
    assert same(cloud, start(scene()[0]))  # what was passed in stays
    assert quality(trained, views) > quality(cloud, views) + 10
    assert same(trained, train(cloud, views, SETTINGS, CpuBackend(2)))
    other = SETTINGS.model_copy(update={"seed": 4})
    assert not same(trained, train(cloud, views, other, BACKEND))


def test_halves_of_a_view_teach_what_the_whole_does(cloud: Gaussians, views: Views) -> None:
    whole = views.cameras[2]
    flat = np.array([-2.5, -2, -1.5], np.float32)
    small = dataclasses.replace(cloud, log_scales=cloud.log_scales + flat)
    half, found = SIZE // 2, []
    for first, last in ((0, SIZE), (0, half), (half, SIZE)):
        middle = (half - first, half)
        camera = dataclasses.replace(whole, width=last - first, principal=middle)
        truth_there = views.images[2][:, first:last]
        lesson = Lesson(camera, truth_there, None, 1, adam.LearningRates(*[1.0] * 6), 1)
        found.append(BACKEND.gradients(small, lesson, 0.01, ssim_weight=0.0))
    for entry in dataclasses.fields(Gaussians):
        one, left, right = (getattr(part.gaussians, entry.name) for part in found)
        assert np.allclose(left + right, one, atol=1e-3 * np.abs(one).max()) and np.any(left)
    assert np.allclose(found[1].centres + found[2].centres, found[0].centres, atol=1e-6)


class Hasty(CpuBackend):
    """Takes several steps at a time, as the gsplat backend does."""

    stretch = 20


def test_stretches_end_where_something_is_due(
    cloud: Gaussians, views: Views, trained: Gaussians
) -> None:
    steps: list[int] = []
    splat = train(cloud, views, SETTINGS, Hasty(1), watch=lambda step, _: steps.append(step))
    assert same(splat, trained)
    assert steps[0] == 20 and steps[-1] == SETTINGS.iterations and max(np.diff(steps)) == 20
    assert {50, 100, 150, SETTINGS.iterations // 2} <= set(steps)


def test_an_interrupted_training_goes_on_to_the_same_result(
    cloud: Gaussians,
    views: Views,
    trained: Gaussians,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gsba.splat.train._CHECKPOINT_EVERY_S", 1e-9)

    def stop(step: int, gaussians: Gaussians) -> None:
        if step == 130:
            raise KeyboardInterrupt

    path = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        train(cloud, views, SETTINGS, BACKEND, path, "key", stop)
    steps: list[int] = []
    keep = lambda step, _: steps.append(step)  # noqa: E731
    rest = train(cloud, views, SETTINGS, BACKEND, path, "key", keep)
    assert steps == list(range(130, 321)) and same(rest, trained)
    assert same(train(cloud, views, SETTINGS, BACKEND, path, "key"), trained)
    short = SETTINGS.model_copy(update={"iterations": 3})
    assert len(train(cloud, views, short, BACKEND, path, "other key")) == 150


class Poison(CpuBackend):
    """Gradients that turn bad after a while."""

    calls = 0

    def gradients(self, *arguments):
        found = super().gradients(*arguments)
        self.calls += 1
        if self.calls > 30:
            found.gaussians.means[5] = np.nan
        return found


def test_what_is_not_finite_stops_the_training(
    cloud: Gaussians, views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsba.splat.train._CHECKPOINT_EVERY_S", 1e-9)
    path = tmp_path / "checkpoint.npz"
    message = r"no longer finite at step 40; .*checkpoint\.npz"
    refused(message, train, cloud, views, SETTINGS, Poison(1), path, "key")
    short, states = SETTINGS.model_copy(update={"iterations": 31}), []
    keep = lambda step, splat: states.append((step, splat.is_finite()))  # noqa: E731
    train(cloud, views, short, BACKEND, path, "key", keep)
    assert states == [(31, True)]  # went on from step 30, the last good one


def test_a_part_of_a_training_leaves_its_start_alone(cloud: Gaussians, views: Views) -> None:
    state = begin(cloud, SETTINGS)
    first = state.copy()
    there = advance(state, views, SETTINGS, BACKEND, 8)
    once = advance(there, views, SETTINGS, BACKEND, 4)
    assert once.step == 12 and same(state.gaussians, first.gaussians)
    assert same(once.gaussians, advance(state, views, SETTINGS, BACKEND, 12).gaussians)
    refused("no longer finite at step 40", advance, state, views, SETTINGS, Poison(1), 40)


def test_the_cap_is_kept_and_said(
    cloud: Gaussians,
    views: Views,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gsba.splat.density._DENSIFY_PULL", 1e-9)
    tight = SETTINGS.model_copy(update={"max_gaussians": 155})
    sizes: list[int] = []
    with caplog.at_level(logging.WARNING, "gsba"):
        train(cloud, views, tight, BACKEND, watch=lambda _, s: sizes.append(len(s)))
    assert max(sizes) <= 155 and "155 Gaussians are the most allowed" in caplog.text
    tiny = SETTINGS.model_copy(update={"max_gaussians": 100, "iterations": 2})
    assert len(train(cloud, views, tiny, BACKEND)) == 100


def test_a_cap_follows_from_pixels_and_memory(
    cloud: Gaussians,
    views: Views,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """23 numbers a Gaussian; 6 views of 32 x 32 pixels have 18,432 values."""
    monkeypatch.setattr("gsba.splat.density._DENSIFY_PULL", 1e-9)
    eager = SETTINGS.model_copy(update={"iterations": 600})
    backend = CpuBackend(1)
    splat = train(cloud, views, eager, backend)
    assert 500 < len(splat) <= 18_432 // 23
    assert "801 Gaussians are the most that 6144 pixels determine" in caplog.text
    half = np.zeros((6, SIZE, SIZE), bool)
    half[:, :16] = True
    masked = dataclasses.replace(views, use=half)
    assert most_gaussians(masked, eager, backend)[0] == 18_432 // 2 // 23
    backend.memory_bytes = 2 * 8 * 4 * 23 * 300
    assert most_gaussians(views, eager, backend) == (300, "that half of 0.0 GB of memory holds")
    assert 150 < len(train(cloud, views, eager, backend)) <= 300
    backend.memory_bytes //= 3
    assert len(begin(cloud, eager).gaussians) == 150  # points are kept, but not added to
    assert len(train(cloud, views, eager, backend)) <= 150


def test_nothing_to_train_on_is_refused(cloud: Gaussians, views: Views) -> None:
    masked = dataclasses.replace(views, use=np.zeros((6, SIZE, SIZE), bool))
    refused("all frames are masked", train, cloud, masked, SETTINGS, BACKEND)
    nothing = cloud.select(np.zeros(150, bool))
    refused("no Gaussian", train, nothing, views, SETTINGS, BACKEND)


def test_published_times_at_the_published_length() -> None:
    times = times_for(30_000)
    assert (times.densify_from, times.densify_until, times.densify_every) == (500, 15_000, 100)
    assert (times.reset_every, times.degree_every) == (3000, 1000)


def test_extent() -> None:
    places = np.array([[-2.0, 0, 0], [2, 0, 0]])
    assert extent_of(places) == pytest.approx(2.2) and extent_of(places[:1]) == 1


def test_first_step_of_adam_is_the_rate() -> None:
    gaussians, _ = scene()
    before = gaussians.select(np.arange(150))
    rng = np.random.default_rng(0)
    parts = (rng.normal(size=array.shape).astype(np.float32) for array in gaussians.arrays())
    gradients = Gaussians(*parts)
    rates = adam.LearningRates(1e-3, 2e-3, 3e-3, 4e-3, 5e-3, 6e-3)
    adam.step(gaussians, gradients, adam.Moments.zero(gaussians), rates, 1)
    moved = gaussians.means - before.means
    assert np.allclose(moved, -1e-3 * np.sign(gradients.means), atol=1e-6)
    moved = gaussians.sh - before.sh
    assert np.allclose(moved[:, 0], -5e-3 * np.sign(gradients.sh[:, 0]), atol=1e-6)
    assert np.allclose(moved[:, 1:], -6e-3 * np.sign(gradients.sh[:, 1:]), atol=1e-6)


def grid(scales: list[float], pulls: list[float]) -> tuple[Gaussians, adam.Moments, Pull]:
    num = len(scales)
    points = np.column_stack([10.0 * np.arange(num), np.zeros((num, 2))])
    gaussians = from_cloud(points, np.zeros((num, 3), np.uint8), 0)
    logs = np.log(np.repeat(np.array(scales, np.float32)[:, None], 3, axis=1))
    gaussians = dataclasses.replace(gaussians, log_scales=logs)
    pull = Pull(np.array(pulls, np.float32) * 2, np.full(num, 2, np.float32))
    return gaussians, adam.Moments.zero(gaussians), pull


def test_small_are_cloned_and_large_are_split() -> None:
    gaussians, moments, pull = grid([0.05, 0.5, 0.5], [1, 1, 0])
    moments.first.means[:] = 1
    found, after, capped = densify(gaussians, moments, pull, *LIMITS, np.random.default_rng(0))
    assert not capped and len(found) == 5
    near = [np.flatnonzero(np.abs(found.means[:, 0] - x) < 3) for x in (0, 10, 20)]
    assert [len(rows) for rows in near] == [2, 2, 1]
    assert np.allclose(found.means[near[0]], 0)  # a clone lies where it came from
    assert np.allclose(np.exp(found.log_scales[near[1]]), 0.5 / 1.6)
    assert len(np.unique(found.means[near[1]], axis=0)) == 2
    assert after.first.means[:, 0].tolist() == [1, 1, 0, 0, 0]  # new ones have not moved


def test_faint_and_huge_are_pruned() -> None:
    gaussians, moments, pull = grid([0.05, 2.0, 0.05], [0, 0, 0])
    gaussians.opacity_logits[2] = -7
    found, _, _ = densify(gaussians, moments, pull, *LIMITS, np.random.default_rng(0))
    assert found.means[:, 0].tolist() == [0]
    gaussians.opacity_logits[:] = -7
    found, _, _ = densify(gaussians, moments, pull, *LIMITS, np.random.default_rng(0))
    assert len(found) == 3  # rather than none


def test_strongest_pulls_come_first_under_the_cap() -> None:
    gaussians, moments, pull = grid([0.05] * 4, [1, 3, 2, 4])
    given = gaussians, moments, pull, 10.0, 6, True, np.random.default_rng(0)
    found, _, capped = densify(*given)
    assert capped and found.means[4:, 0].tolist() == [10, 30]


def test_reset_of_opacity() -> None:
    gaussians, moments, _ = grid([0.05] * 2, [0, 0])
    gaussians.opacity_logits[:] = [2, -6]
    moments.second.opacity_logits[:] = 1
    found, after = reset_opacity(gaussians, moments)
    assert np.allclose(1 / (1 + np.exp(-found.opacity_logits)), [0.01, 1 / (1 + np.exp(6))])
    assert not after.second.opacity_logits.any()


def test_a_missing_gsplat_is_one_line() -> None:
    try:
        backend = choose_backend("gsplat")
    except GsbaError as error:
        assert "\n" not in str(error) and "--backend cpu" in str(error)
        assert choose_backend("auto").name == "cpu"
    else:
        assert backend.name == "gsplat"
