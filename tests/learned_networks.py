"""Untrained networks in the layouts that their authors publish, saved as the authors do.

SuperPoint and SuperGlue are written out here once more, from their papers, under the authors' names
of layers: what is loaded into other libraries must compute the same.
"""

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed (extra: learned)")
kornia_feature = pytest.importorskip("kornia.feature", reason="kornia is not installed")
pytest.importorskip("transformers", reason="transformers is not installed (extra: learned)")

EXTRACTORS = ("aliked", "disk", "xfeat", "superpoint")
DIMENSIONS = {"aliked": 128, "disk": 128, "xfeat": 64, "superpoint": 256}
nn, functional = torch.nn, torch.nn.functional


class OfficialSuperPoint(nn.Module):
    """DeTone et al., 2018, with the layers of superpoint_v1.pth."""

    def __init__(self) -> None:
        super().__init__()
        channels = (1, 64, 64, 128, 128)
        for block in range(1, 5):
            before, after = channels[block - 1], channels[block]
            setattr(self, f"conv{block}a", nn.Conv2d(before, after, 3, padding=1))
            setattr(self, f"conv{block}b", nn.Conv2d(after, after, 3, padding=1))
        self.convPa, self.convPb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, 65, 1)
        self.convDa, self.convDb = nn.Conv2d(128, 256, 3, padding=1), nn.Conv2d(256, 256, 1)

    def forward(self, grey):
        """Heat (H, W) and dense descriptors (256, H / 8, W / 8) of an image (1, 1, H, W)."""
        x = grey
        for block in range(1, 5):
            x = functional.relu(getattr(self, f"conv{block}a")(x))
            x = functional.relu(getattr(self, f"conv{block}b")(x))
            x = functional.max_pool2d(x, 2) if block < 4 else x
        cells = self.convPb(functional.relu(self.convPa(x))).softmax(1)[:, :64]
        dense = functional.normalize(self.convDb(functional.relu(self.convDa(x))), dim=1)
        return functional.pixel_shuffle(cells, 8)[0, 0], dense[0]


def _layers(*channels: int):
    stack = []
    for i in range(1, len(channels)):
        stack.append(nn.Conv1d(channels[i - 1], channels[i], 1))
        if i < len(channels) - 1:
            stack += [nn.BatchNorm1d(channels[i]), nn.ReLU()]
    return nn.Sequential(*stack)


class _Attention(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.merge = nn.Conv1d(256, 256, 1)
        self.proj = nn.ModuleList(nn.Conv1d(256, 256, 1) for _ in range(3))

    def forward(self, x, source):
        queries, keys, values = (
            layer(y)[0].reshape(64, 4, -1)
            for layer, y in zip(self.proj, (x, source, source), strict=True)
        )
        weights = (torch.einsum("dhn,dhm->hnm", queries, keys) / 8).softmax(-1)
        message = torch.einsum("hnm,dhm->dhn", weights, values)
        return self.merge(message.reshape(1, 256, -1))


class _Propagation(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.attn, self.mlp = _Attention(), _layers(512, 512, 256)

    def forward(self, x, source):
        return self.mlp(torch.cat([x, self.attn(x, source)], dim=1))


class OfficialSuperGlue(nn.Module):
    """Sarlin et al., 2020, with the layers of superglue_outdoor.pth."""

    def __init__(self) -> None:
        super().__init__()
        self.bin_score = nn.Parameter(torch.tensor(1.0))
        self.kenc, self.gnn = nn.Module(), nn.Module()
        self.kenc.encoder = _layers(3, 32, 64, 128, 256, 256)
        self.gnn.layers = nn.ModuleList(_Propagation() for _ in range(18))
        self.final_proj = nn.Conv1d(256, 256, 1)

    def forward(self, sides, size: int):
        """Probability (n0, n1) that two keypoints match; sides hold pixels, descriptors, scores."""
        x = []
        for pixels, descriptors, scores in sides:
            placed = (pixels - size / 2) / (0.7 * size)
            code = self.kenc.encoder(torch.cat([placed, scores[:, None]], dim=1).T[None])
            x.append(descriptors.T[None] + code)
        for i, layer in enumerate(self.gnn.layers):
            other = x if i % 2 == 0 else x[::-1]
            x = [a + layer(a, b) for a, b in zip(x, other, strict=True)]
        first, second = (self.final_proj(a)[0] for a in x)
        return self._transport(first.T @ second / 16)

    def _transport(self, scores):
        n0, n1 = scores.shape
        padded = functional.pad(scores, (0, 1, 0, 1), value=float(self.bin_score.detach()))
        rows, columns = torch.ones(n0 + 1), torch.ones(n1 + 1)
        rows[-1], columns[-1] = n1, n0
        u, v = torch.zeros(n0 + 1), torch.zeros(n1 + 1)
        for _ in range(100):
            u = rows.log() - torch.logsumexp(padded + v, dim=1)
            v = columns.log() - torch.logsumexp(padded + u[:, None], dim=0)
        return (padded + u[:, None] + v).exp()[:-1, :-1]


def save_extractors(folder: Path) -> dict[str, Path]:
    """Files of random weights by extractor; detections of all are spread over the image."""
    torch.manual_seed(0)
    xfeat = kornia_feature.XFeat().net
    nn.init.normal_(xfeat.keypoint_head[3].weight, std=3.0)  # or nothing stands out
    superpoint = OfficialSuperPoint()
    for layer in superpoint.children():  # or biases drown the image, and all looks alike
        nn.init.kaiming_normal_(layer.weight)
        nn.init.zeros_(layer.bias)
    states = {
        "aliked-n16.pth": kornia_feature.ALIKED("aliked-n16").state_dict(),
        "depth-save.pth": {"extractor": kornia_feature.DISK().state_dict()},
        "xfeat.pt": xfeat.state_dict(),
        "superpoint_v1.pth": superpoint.state_dict(),
    }
    for name, state in states.items():
        torch.save(state, folder / name)
    return dict(zip(EXTRACTORS, (folder / name for name in states), strict=True))


def official_lightglue(state: dict, num_layers: int, prefix: str = "") -> dict:
    """A state of kornia's LightGlue under the names of the authors' files."""
    for block in ("self_attn", "cross_attn"):
        for i in range(num_layers):
            old, new = f"transformers.{i}.{block}.", f"{block}.{i}."
            state = {name.replace(old, new): value for name, value in state.items()}
    return {prefix + name: value for name, value in state.items()}


def save_transparent_matcher(folder: Path, matcher: str, extractor: str) -> Path:
    """File of a matcher whose attention changes nothing: it compares descriptors.

    Of two keypoints it makes a match where each is the other's most alike, so that what it finds
    on known descriptors is known.
    """
    if matcher == "lightglue":
        names = {"xfeat": "xfeat-lighterglue.pt"}
        path = folder / names.get(extractor, f"{extractor}_lightglue.pth")
        torch.save(_transparent_lightglue(extractor), path)
        return path
    glue = OfficialSuperGlue()
    with torch.no_grad():
        glue.final_proj.weight.copy_(400 * torch.eye(256)[..., None])
        for layer in (glue.kenc.encoder[-1], *(x.mlp[-1] for x in glue.gnn.layers)):
            layer.weight.zero_()
            layer.bias.zero_()
    torch.save(glue.state_dict(), folder / "superglue_outdoor.pth")
    return folder / "superglue_outdoor.pth"


def lightglue(extractor: str):
    """Kornia's LightGlue of an extractor with random weights."""
    conf = {**kornia_feature.LightGlue.features[extractor], "weights": None}
    return kornia_feature.LightGlue(features=None, **conf)


def _transparent_lightglue(extractor: str) -> dict:
    model = lightglue(extractor)
    with torch.no_grad():
        for name, value in model.named_parameters():
            if ".ffn.3." in name:
                value.zero_()
            elif "final_proj" in name:
                gain = 4000 if extractor == "xfeat" else 400  # what tells descriptors apart
                value.copy_(gain * torch.eye(len(value)) if value.ndim == 2 else 0 * value)
            elif "matchability" in name:
                value.fill_(0.0 if value.ndim == 2 else 10.0)
            elif "input_proj" in name:
                value.copy_(torch.eye(*value.shape) if value.ndim == 2 else 0 * value)
    prefix = "matcher." if extractor == "xfeat" else ""
    return official_lightglue(model.state_dict(), model.conf.n_layers, prefix)
