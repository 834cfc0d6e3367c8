"""Recordings of a run, as `gsba refine` is told of them."""

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsba.log import GsbaError, brief

if TYPE_CHECKING:
    from gsba.pipeline import Recording

_PATHS = ("keyframes", "timestamps", "calibration", "imu")  # keys whose value is a file
_SEVERAL = ("trajectory", "masks")  # keys that may be repeated
_KEYS = ("name", "camera", "fps", "odometry", "circles", *_SEVERAL, *_PATHS)
_MASK_WORDS = ("auto", "carrier", "distractors", "none")


def circle_of(text: str) -> tuple[float, float, float]:
    """Centre and radius of `--circle X,Y,R`."""
    try:
        x, y, radius = (float(part) for part in text.split(","))
    except ValueError:
        raise GsbaError(
            f"--circle {text}: give a centre and a radius as three numbers X,Y,R"
        ) from None
    return x, y, radius


def grouped(given: Sequence[Path]) -> list[tuple[Path, list[Path]]]:
    """Folders and videos of recordings, each with the trajectory files that follow it."""
    from gsba.video import is_video

    groups: list[tuple[Path, list[Path]]] = []
    for path in given:
        if not groups or path.is_dir() or is_video(path):
            groups.append((path, []))
        else:
            groups[-1][1].append(path)
    return groups


def recordings_of(
    given: Sequence[Path], options: Sequence[str], shared: Mapping[str, Any]
) -> "list[Recording]":
    """The recordings of a run: those given as arguments, then those of `--recording`.

    `PATH.toml` beside the frames of a recording, named after its folder or video, holds further
    keys; those of the command line have precedence over it, and it has over the shared ones.

    Args:
        given: arguments of the command, see `grouped`.
        options: values of `--recording`: PATH,KEY=VALUE,...
        shared: fields that all recordings have unless theirs say otherwise.

    Raises:
        GsbaError: a key or a value that no recording can have.
    """
    from gsba.pipeline import Recording

    found = []
    for path, files in grouped(given):
        found.append((path, {"trajectory": files} if files else {}))
    found += [_parsed(text) for text in options]
    return [Recording(path, **(dict(shared) | _beside(path) | own)) for path, own in found]


def _parsed(text: str) -> tuple[Path, dict[str, Any]]:
    """Path and fields of `--recording PATH,KEY=VALUE,...`."""
    path, *pairs = re.split(r",(?=[a-z_]+=)", text)
    if not path or "=" in path.partition("/")[0]:
        raise GsbaError(f"--recording {brief(text)}: give PATH,KEY=VALUE,... with the path first")
    fields: dict[str, Any] = {}
    for pair in pairs:
        key, _, value = pair.partition("=")
        plain: Any = value
        if key not in (*_PATHS, *_SEVERAL, "name", "camera"):
            with suppress(ValueError):  # refused below, with the key
                plain = tomllib.loads(f"value = {value}")["value"]
        fields.setdefault(key, []).append(plain)
    single = {key: values if key in _SEVERAL else values[-1] for key, values in fields.items()}
    return Path(path), _checked(single, Path(), f"--recording {path}")


def _beside(frames: Path) -> dict[str, Any]:
    """Fields in the TOML file beside the frames of a recording; {} if there is none."""
    from gsba.config_file import read_toml

    name = frames.resolve().stem if frames.is_file() else frames.resolve().name
    path = frames.resolve().with_name(f"{name}.toml")
    if not path.is_file():
        return {}
    return _checked(read_toml(path), path.parent, str(path))


def _checked(fields: Mapping[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """Fields of a recording with relative paths taken from `folder`."""
    checked: dict[str, Any] = {}
    for key, value in fields.items():
        if key not in _KEYS:
            raise GsbaError(f"{where}: unknown key {key!r}; known are {', '.join(_KEYS)}")
        values = value if isinstance(value, list) else [value]
        if key in (*_PATHS, *_SEVERAL, "name", "camera"):
            fitting = all(isinstance(one, str) for one in values)
            fitting &= key in _SEVERAL or len(values) == 1
        elif key == "circles":
            fitting = all(isinstance(one, list) and len(one) == 3 for one in values)
        elif key == "odometry":
            fitting = isinstance(value, bool)
        else:
            fitting = isinstance(value, int | float) and not isinstance(value, bool)
        if not fitting:
            raise GsbaError(f"{where}: {key} = {brief(json.dumps(value, default=str))} is no {key}")
        if key == "trajectory":
            checked[key] = [folder / one for one in values]
        elif key == "masks":
            checked[key] = [one if one in _MASK_WORDS else folder / one for one in values]
        elif key in _PATHS:
            checked[key] = folder / values[0]
        else:
            checked[key] = value
    return checked
