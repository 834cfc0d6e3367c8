"""Learned extractors with random weights in the official layouts: what all extractors promise."""

from pathlib import Path

import numpy as np
import pytest

from gsba import refine
from gsba.config import FeatureSettings
from gsba.learned import LearnedExtractor, _load
from gsba.log import GsbaError

torch = pytest.importorskip("torch", reason="torch is not installed (extra: learned)")
kornia_feature = pytest.importorskip("kornia.feature", reason="kornia is not installed")

SIZE = 120  # no multiple of what the networks want


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files as the authors publish them, of untrained networks."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    paths = {"aliked": folder / "aliked-n16.pth", "disk": folder / "depth-save.pth"}
    torch.save(kornia_feature.ALIKED("aliked-n16").state_dict(), paths["aliked"])
    torch.save({"extractor": kornia_feature.DISK().state_dict()}, paths["disk"])
    return paths


def _image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, 3)).astype(np.uint8)


@pytest.mark.parametrize("name", ["aliked", "disk"])
def test_contract(weights: dict[str, Path], name: str) -> None:
    settings = FeatureSettings.model_validate(
        {"extractor": name, "weights": str(weights[name]), "max_per_face": 60}
    )
    extractor, image = LearnedExtractor(settings), _image()
    found, again = extractor(image, None), LearnedExtractor(settings)(image, None)
    assert 20 < len(found.pixels) <= 60 and found.pixels.dtype == np.float64
    assert (found.pixels >= 0).all() and (found.pixels < SIZE).all()
    assert found.descriptors.shape == (len(found.pixels), 128)
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-4)
    assert found.sigmas_px.shape == (len(found.pixels),) and (found.sigmas_px > 0).all()
    np.testing.assert_array_equal(found.pixels, again.pixels)
    np.testing.assert_array_equal(found.descriptors, again.descriptors)
    mask = np.zeros((SIZE, SIZE), bool)
    mask[:, :50] = True
    masked = extractor(image, mask)
    assert len(masked.pixels) and (masked.pixels[:, 0] < 50).all()


@pytest.mark.parametrize("name", ["aliked", "disk"])
def test_pixels_count_from_the_corner(
    weights: dict[str, Path], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The networks count from the centre of the first pixel; the strongest comes first."""

    class Found:
        keypoints = torch.tensor([[0.0, 0.0], [10.25, 20.5], [SIZE + 3.0, 5.0]])
        descriptors = torch.eye(128)[:3]
        keypoint_scores = detection_scores = torch.tensor([0.1, 0.9, 0.95])

    settings = FeatureSettings.model_validate({"extractor": name, "weights": str(weights[name])})
    extractor = LearnedExtractor(settings)
    monkeypatch.setattr(extractor, "_model", lambda image, **_: [Found])
    found = extractor(_image(), None)
    np.testing.assert_allclose(found.pixels, [[10.75, 21.0], [0.5, 0.5]])  # none in the padding
    np.testing.assert_array_equal(found.descriptors.argmax(axis=1), [1, 0])


def test_missing_and_wrong_weights_are_one_line(weights: dict[str, Path], tmp_path: Path) -> None:
    _load.cache_clear()
    (tmp_path / "bad.pth").write_bytes(b"no weights")
    torch.save([1, 2, 3], tmp_path / "list.pth")
    for path, message in (
        (None, r"needs weights: get aliked-n16\.pth \(BSD-3-Clause\) from https://github\.com/"),
        (tmp_path / "none.pth", r"none\.pth: no such weights file; get aliked-n16\.pth"),
        (tmp_path / "bad.pth", r"bad\.pth: not a file of weights"),
        (tmp_path / "list.pth", "weights of another network than aliked"),
        (weights["disk"], "weights of another network than aliked"),
    ):
        chosen = {"extractor": "aliked", "weights": None if path is None else str(path)}
        with pytest.raises(GsbaError, match=message) as failure:
            LearnedExtractor(FeatureSettings.model_validate(chosen))
        assert "\n" not in str(failure.value)


def test_missing_library_is_one_line(
    weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    _load.cache_clear()
    monkeypatch.setitem(__import__("sys").modules, "kornia.feature", None)
    chosen = {"extractor": "disk", "weights": str(weights["disk"])}
    with pytest.raises(GsbaError, match=r"pip install 'gsba\[learned\]'"):
        LearnedExtractor(FeatureSettings.model_validate(chosen))


def test_refine_fails_before_it_starts(case, tmp_path: Path) -> None:
    from tiny_run import SETTINGS

    chosen = FeatureSettings(extractor="disk")
    with pytest.raises(GsbaError, match="needs weights: get depth-save"):
        refine(case.frames, case.slam, tmp_path, SETTINGS.model_copy(update={"features": chosen}))
