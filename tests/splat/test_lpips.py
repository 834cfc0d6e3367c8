"""LPIPS from files in the layout of its authors, with random weights, against plain modules."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from gsba.splat.scores import Lpips

torch = pytest.importorskip("torch")
RNG = np.random.default_rng(0)
IMAGE, TRUTH = RNG.random((2, 64, 64, 3))
SLICES = {  # layers of the backbone, as the authors slice them
    "alex": ((0, 1), (3, 2), (6, 3), (8, 4), (10, 5)),
    "vgg": tuple(
        (k, 1 + sum(k > last for last in (2, 7, 14, 21)))
        for k in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    ),
}
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}


def backbone(net: str):
    """The convolutional part as torchvision numbers it."""
    nn = torch.nn
    torch.manual_seed(0)
    if net == "alex":
        relu, pool = nn.ReLU(), nn.MaxPool2d(3, 2)
        return nn.Sequential(
            nn.Conv2d(3, 64, 11, 4, 2), relu, pool, nn.Conv2d(64, 192, 5, padding=2), relu, pool,
            nn.Conv2d(192, 384, 3, padding=1), relu, nn.Conv2d(384, 256, 3, padding=1), relu,
            nn.Conv2d(256, 256, 3, padding=1), relu,
        )  # fmt: skip
    layers, channels = [], 3
    for width in (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512):
        if width:
            layers += [nn.Conv2d(channels, width, 3, padding=1), nn.ReLU()]
            channels = width
        else:
            layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


def weights(net: str, folder: Path, whole: bool = True) -> tuple[list[Path], object, list]:
    """Files of random weights, the backbone, and the heads."""
    layers = backbone(net)
    widths = [layers[tap - 1].out_channels for tap in TAPS[net]]
    heads = [torch.rand(1, width, 1, 1) for width in widths]
    lins = {f"lin{i}.model.1.weight": head for i, head in enumerate(heads)}
    if whole:
        state = {"scaling_layer.shift": torch.zeros(1, 3, 1, 1), **lins}
        state |= {f"lins.{name[3]}{name[4:]}": head for name, head in lins.items()}
        for k, part in SLICES[net]:
            for name, value in layers[k].state_dict().items():
                state[f"net.slice{part}.{k}.{name}"] = value
        torch.save(state, folder / "lpips.pth")
        return [folder / "lpips.pth"], layers, heads
    features = {f"features.{name}": value for name, value in layers.state_dict().items()}
    torch.save({**features, "classifier.1.weight": torch.zeros(2, 2)}, folder / "backbone.pth")
    torch.save(lins, folder / "heads.pth")
    return [folder / "backbone.pth", folder / "heads.pth"], layers, heads


def direct(layers, heads: list, taps: tuple[int, ...]) -> float:
    """The distance by plain modules."""
    shift = torch.tensor([-0.030, -0.088, -0.188]).reshape(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450]).reshape(1, 3, 1, 1)
    found = []
    for image in (IMAGE, TRUTH):
        x = (
            2 * torch.tensor(image, dtype=torch.float32).permute(2, 0, 1)[None] - 1 - shift
        ) / scale
        outputs = []
        for k, layer in enumerate(layers):
            x = layer(x)
            if k in taps:
                outputs.append(torch.nn.functional.normalize(x, dim=1))
        found.append(outputs)
    parts = zip(*found, heads, strict=True)
    return sum(float((((a - b) ** 2) * head).sum(dim=1).mean()) for a, b, head in parts)


@pytest.mark.parametrize("net", ["alex", "vgg"])
@pytest.mark.parametrize("whole", [True, False])
def test_distance_is_that_of_the_modules(net: str, whole: bool, tmp_path: Path) -> None:
    paths, layers, heads = weights(net, tmp_path, whole)
    lpips = Lpips(paths)
    with torch.inference_mode():
        expected = direct(layers, heads, TAPS[net])
    assert lpips.net == net
    assert lpips(IMAGE, TRUTH) == pytest.approx(expected, rel=1e-4)
    assert lpips(TRUTH, TRUTH) == 0


def test_masked_pixels_have_no_say(tmp_path: Path) -> None:
    lpips = Lpips(weights("alex", tmp_path)[0])
    use = np.zeros((64, 64), bool)
    assert lpips(IMAGE, TRUTH, use) == 0
    refused("32 pixels", lpips, IMAGE[:16, :16], TRUTH[:16, :16])


def test_other_files_are_refused(tmp_path: Path) -> None:
    alex, other = tmp_path / "a", tmp_path / "b"
    alex.mkdir()
    other.mkdir()
    (backbone_path, heads), vgg = weights("alex", alex, False)[0], weights("vgg", other, False)[0]
    for paths, message in (
        ([tmp_path / "nothing.pth"], "no such file"),
        ([heads], "no weights of AlexNet"),
        ([backbone_path], "linear heads of LPIPS are missing"),
        ([backbone_path, vgg[1]], "another network than alex"),
    ):
        refused(message, Lpips, paths)
    (tmp_path / "text.pth").write_text("hello")
    refused("not a file of weights", Lpips, [tmp_path / "text.pth"])
