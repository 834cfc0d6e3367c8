"""Learned extractors with random weights in the official layouts: what all extractors promise."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from learned_networks import DIMENSIONS, EXTRACTORS, OfficialSuperPoint, save_extractors, torch
from refusals import refused
from scipy.ndimage import map_coordinates

import gsba.learned
from gsba import refine
from gsba.config import FeatureSettings, RefineSettings
from gsba.config_file import load_config
from gsba.features.detection import TRAITS
from gsba.learned import LearnedExtractor, find_weights
from gsba.learned.extractor import _load
from gsba.log import GsbaError

SIZE = 120  # no multiple of what the networks want


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return save_extractors(tmp_path_factory.mktemp("weights"))


@pytest.fixture(autouse=True)
def no_caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this machine has cached or installed stays unseen."""
    monkeypatch.setattr("gsba.learned.weights.packaged", lambda names: None)
    for name in ("TORCH_HOME", "HF_HOME", "HF_HUB_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def _image(size: int = SIZE, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (size, size, 3)).astype(np.uint8)


def _extractor(weights: dict[str, Path], name: str, max_per_face: int = 60) -> LearnedExtractor:
    chosen = {"extractor": name, "max_per_face": max_per_face}
    return LearnedExtractor(FeatureSettings.model_validate(chosen), weights[name])


@pytest.mark.parametrize("name", EXTRACTORS)
def test_contract(weights: dict[str, Path], name: str) -> None:
    extractor, image = _extractor(weights, name), _image()
    found, again = extractor(image, None), _extractor(weights, name)(image, None)
    num = len(found.pixels)
    assert 20 < num <= 60 and found.pixels.dtype == np.float64
    assert (found.pixels >= 0).all() and (found.pixels < SIZE).all()
    assert found.descriptors.shape == (num, DIMENSIONS[name])
    assert found.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
    assert found.sigmas_px.shape == (num,) and (found.sigmas_px > 0).all()
    assert found.scores is not None and (np.diff(found.scores) <= 0).all()  # strongest first
    np.testing.assert_array_equal(found.pixels, again.pixels)
    np.testing.assert_array_equal(found.descriptors, again.descriptors)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, :50] = True
    masked = extractor(image, mask)
    assert len(masked.pixels) and (masked.pixels[:, 0] < 50).all()


@pytest.mark.parametrize("name", EXTRACTORS)
def test_a_shifted_image_shifts_its_keypoints(weights: dict[str, Path], name: str) -> None:
    """By exactly as much, in both directions: nothing is resized, no axis is swapped. Away from
    the borders, as what lies beyond them differs; a few of untrained networks' many near ties
    still fall otherwise (one in five of DISK's, whose norms see the whole image). By chance one
    in a thousand would agree."""
    extractor, image = _extractor(weights, name, 600), _image(256)
    before = extractor(image, None)
    after = extractor(np.roll(image, (64, 32), axis=(0, 1)), None)  # down, right
    inside = ((before.pixels > 64) & (before.pixels < 128)).all(axis=1)
    moved = before.pixels[inside] + [32.0, 64.0]
    distances = np.linalg.norm(moved[:, None] - after.pixels[None], axis=2)
    nearest = distances.argmin(axis=1)
    same = distances.min(axis=1) < 0.02
    assert len(same) > 10 and same.mean() > 0.7
    likeness = (before.descriptors[inside] * after.descriptors[nearest]).sum(axis=1)
    assert (likeness[same] > 0.9).mean() > 0.9


@pytest.mark.parametrize("name", EXTRACTORS)
def test_a_face_is_never_resized(
    weights: dict[str, Path], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network sees every pixel as it is, and beyond the face only its border drawn out."""
    extractor, seen = _extractor(weights, name), []
    detect = extractor._detect
    monkeypatch.setattr(extractor, "_detect", lambda image: (seen.append(image), detect(image))[1])
    extractor(_image(), None)
    assert seen[0].shape == (128, 128, 3)
    np.testing.assert_array_equal(seen[0][:SIZE, :SIZE], _image())
    np.testing.assert_array_equal(
        seen[0][SIZE:, SIZE:], np.broadcast_to(_image()[-1, -1], (8, 8, 3))
    )


@pytest.mark.parametrize("name", EXTRACTORS)
def test_a_blank_face_is_no_failure(weights: dict[str, Path], name: str) -> None:
    found = _extractor(weights, name)(np.zeros((SIZE, SIZE, 3), np.uint8), None)
    assert found.descriptors.shape == (len(found.pixels), DIMENSIONS[name])
    assert np.isfinite(found.descriptors).all()


def test_pixels_count_from_the_corner(
    weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The networks count from the centre of the first pixel; the strongest comes first."""
    pixels = np.array([[0.0, 0.0], [10.25, 20.5], [SIZE + 3.0, 5.0]], np.float32)
    extractor = _extractor(weights, "aliked")
    given = pixels, np.array([0.1, 0.9, 0.95], np.float32), np.eye(3, 128, dtype=np.float32)
    monkeypatch.setattr(extractor, "_detect", lambda image: given)
    found = extractor(_image(), None)
    expected = np.array([[10.75, 21.0], [0.5, 0.5]]) + TRAITS["aliked"].offset_px
    np.testing.assert_allclose(found.pixels, expected)  # none in the padding
    np.testing.assert_array_equal(found.sigmas_px, TRAITS["aliked"].sigma_px)
    np.testing.assert_array_equal(found.descriptors.argmax(axis=1), [1, 0])


def test_superpoint_is_that_of_the_paper(weights: dict[str, Path]) -> None:
    """Keypoints lie where the paper's network is hottest, and are scored by that heat."""
    model = OfficialSuperPoint()
    model.load_state_dict(torch.load(weights["superpoint"], weights_only=True))
    image = _image(128)
    found = _extractor(weights, "superpoint", 1000)(image, None)
    assert found.scores is not None
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    with torch.inference_mode():
        heat, dense = model(torch.from_numpy(grey)[None, None])
    columns, rows = (found.pixels - 0.5).astype(int).T
    np.testing.assert_allclose(found.scores, heat.numpy()[rows, columns], rtol=1e-5)
    for beside in (heat.numpy()[rows, columns - 1], heat.numpy()[rows - 1, columns]):
        assert not np.isclose(found.scores, beside, rtol=1e-4).any()
    around = [  # a few lie beside hotter ones that others have suppressed
        heat.numpy()[max(r - 4, 0) : r + 5, max(c - 4, 0) : c + 5].max()
        for r, c in zip(rows, columns, strict=True)
    ]
    assert np.isclose(found.scores, around, rtol=1e-5).mean() > 0.8
    # Descriptors between those of cells, the first at 3.5 and, as published, the last at 127.
    at = (found.pixels - 4) * (15 / 123.5)
    inside = ((at >= 0) & (at <= 15)).all(axis=1)
    sampled = [map_coordinates(c, at[inside][:, ::-1].T, order=1) for c in dense.numpy()]
    expected = np.array(sampled).T / np.linalg.norm(sampled, axis=0)[:, None]
    np.testing.assert_allclose(found.descriptors[inside], expected, atol=1e-4)


def test_weights_of_transformers_are_the_same_network(
    weights: dict[str, Path], tmp_path: Path
) -> None:
    from safetensors.torch import save_file
    from transformers import SuperPointConfig, SuperPointForKeypointDetection

    from gsba.learned.magicleap import _superpoint_name

    state = torch.load(weights["superpoint"], weights_only=True)
    other = {_superpoint_name(name): value for name, value in state.items()}
    SuperPointForKeypointDetection(SuperPointConfig()).load_state_dict(other)  # all and no more
    save_file(other, tmp_path / "model.safetensors")
    chosen = FeatureSettings(extractor="superpoint", max_per_face=60)
    found = LearnedExtractor(chosen, tmp_path / "model.safetensors")(_image(), None)
    expected = _extractor(weights, "superpoint")(_image(), None)
    np.testing.assert_array_equal(found.pixels, expected.pixels)
    np.testing.assert_array_equal(found.descriptors, expected.descriptors)


@pytest.mark.parametrize("name", EXTRACTORS)
def test_wrong_weights_are_one_line(weights: dict[str, Path], name: str, tmp_path: Path) -> None:
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    (tmp_path / "bad.safetensors").write_bytes(b"no weights")
    torch.save([1, 2, 3], tmp_path / "list.pth")
    other = weights["disk" if name == "aliked" else "aliked"]
    for path, message in (
        (tmp_path / "bad.pth", r"bad\.pth is not a file of weights"),
        (tmp_path / "bad.safetensors", r"bad\.safetensors is not a file of weights"),
        (tmp_path / "list.pth", f"weights of another network than {name}"),
        (other, f"weights of another network than {name}"),
    ):
        refused(
            message, LearnedExtractor, FeatureSettings.model_validate({"extractor": name}), path
        )


@pytest.mark.parametrize(
    ("name", "module"), [("disk", "kornia.feature"), ("superpoint", "transformers")]
)
def test_missing_library_is_one_line(
    weights: dict[str, Path], name: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    _load.cache_clear()
    for ours in ("detectors", "magicleap"):
        monkeypatch.delitem(sys.modules, f"gsba.learned.{ours}", raising=False)
        monkeypatch.delattr(gsba.learned, ours, raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    refused(r"pip install 'gsba\[learned\]'", _extractor, weights, name)


def _settings(extractor: str, matcher: str = "guided", **features: object) -> RefineSettings:
    chosen = {"extractor": extractor, **features}
    return RefineSettings.model_validate({"features": chosen, "matching": {"matcher": matcher}})


def test_missing_weights_are_one_line(tmp_path: Path) -> None:
    for given, message in (
        (
            None,
            r"no weights of ALIKED; pip install .*, or get aliked-n16\.pth \(BSD-3-Clause\) from https://github",
        ),
        (tmp_path / "none.pth", r"none\.pth: no such weights file; get aliked-n16\.pth"),
        (tmp_path, r"holds no weights of ALIKED; .*get aliked"),
    ):
        settings = _settings("aliked", weights=None if given is None else str(given))
        refused(message, find_weights, settings)
    with pytest.raises(GsbaError, match=r"LightGlue for disk; .*get disk_lightglue\.pth \(Apache"):
        (tmp_path / "depth-save.pth").touch()
        find_weights(_settings("disk", "lightglue", weights=str(tmp_path)))


def test_weights_are_found_in_folders_and_caches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under the official names in a folder; in caches as torch, kornia and transformers keep
    them; where several are, the folder's."""
    torch_cache = tmp_path / "cache/torch/hub/checkpoints"
    snapshot = tmp_path / "cache/huggingface/hub/models--magic-leap-community--superpoint"
    for file in (
        torch_cache / "aliked-n16.pth",
        torch_cache / "aliked_lightglue_v0-1_arxiv-pth",
        snapshot / "snapshots/abc/model.safetensors",
        tmp_path / "own/aliked-n16.pth",
    ):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (snapshot / "refs").mkdir()
    (snapshot / "refs/main").write_text("abc")
    found = find_weights(_settings("aliked", "lightglue"))
    assert found["features"] == torch_cache / "aliked-n16.pth"
    assert found["matching"] == torch_cache / "aliked_lightglue_v0-1_arxiv-pth"
    found = find_weights(_settings("aliked", "lightglue", weights=str(tmp_path / "own")))
    assert found["features"] == tmp_path / "own/aliked-n16.pth"
    found = find_weights(_settings("superpoint", accept_noncommercial=True))
    assert found["features"] == snapshot / "snapshots/abc/model.safetensors"
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "elsewhere"))
    refused("no weights of ALIKED", find_weights, _settings("aliked"))


def test_noncommercial_weights_need_consent(
    weights: dict[str, Path], caplog: pytest.LogCaptureFixture
) -> None:
    path = str(weights["superpoint"])
    with pytest.raises(GsbaError, match=r"non-commercial research only.*--accept-noncommercial"):
        find_weights(_settings("superpoint", weights=path))
    accepted = _settings("superpoint", weights=path, accept_noncommercial=True)
    assert find_weights(accepted) == {"features": weights["superpoint"]}
    assert "SuperPoint's weights are under Magic Leap's licence" in caplog.text
    with pytest.raises(GsbaError, match="no weights of SuperGlue; get superglue_outdoor"):
        find_weights(_settings("superpoint", "superglue", weights=path, accept_noncommercial=True))
    caplog.clear()
    find_weights(_settings("aliked", weights=str(weights["aliked"])))
    assert not caplog.text


def test_weights_are_fetched_only_when_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the first source that answers, into torch's cache."""
    source = tmp_path / "served.pth"
    source.write_bytes(b"weights")
    import gsba.learned.weights as module

    asked = []

    def urlopen(url: str, timeout: float):
        asked.append(url)
        if "huggingface" in url:
            raise OSError("no route")
        return source.open("rb")

    monkeypatch.setattr(module.urllib.request, "urlopen", urlopen)
    refused("or pass --download", find_weights, _settings("aliked"))
    assert not asked
    found = find_weights(_settings("aliked", download=True))["features"]
    assert found == tmp_path / "cache/torch/hub/checkpoints/aliked-n16.pth"
    assert found.read_bytes() == b"weights" and len(asked) == 2
    assert find_weights(_settings("aliked"))["features"] == found

    def offline(url: str, timeout: float):
        raise OSError("no route")

    monkeypatch.setattr(module.urllib.request, "urlopen", offline)
    with pytest.raises(GsbaError, match=r"could not download depth-save\.pth \(no route\); get it"):
        find_weights(_settings("disk", download=True))


def test_options_say_where_weights_are(tmp_path: Path) -> None:
    """A folder is for all, files go before it wherever they stand; a name decides whose it is."""
    from gsba.cli.refining import _networks

    file, glue = tmp_path / "mine.pth", tmp_path / "aliked_LightGlue.pth"
    file.touch()
    glue.touch()
    for given, expected in (
        ([tmp_path], (tmp_path, tmp_path)),
        ([file, tmp_path], (file, tmp_path)),
        ([tmp_path, glue], (tmp_path, glue)),
        ([glue, file], (file, glue)),
        ([], (None, None)),
    ):
        settings = load_config(overrides=_networks(given, False, False))
        found = settings.features.weights, settings.matching.weights
        assert found == tuple(None if path is None else str(path) for path in expected)
        assert not settings.features.accept_noncommercial and not settings.features.download
    chosen = load_config(overrides=_networks(None, True, True)).features
    assert chosen.accept_noncommercial and chosen.download


def test_refine_fails_before_it_starts(case, tmp_path: Path) -> None:
    from tiny_run import SETTINGS

    chosen = FeatureSettings(extractor="disk")
    with pytest.raises(GsbaError, match=r"no weights of DISK; .*get depth-save"):
        refine(case.frames, case.slam, tmp_path, SETTINGS.model_copy(update={"features": chosen}))
