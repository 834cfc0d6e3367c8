"""Calibrations of raw lenses in files: JSON of our own form (metres, or as `unit` says),
and those of `calibration_formats`. The rig's origin is moved into the middle of the lenses."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.calibration_formats import (
    fields_of,
    from_colmap_config,
    from_colmap_model,
    from_kalibr,
    lens_of,
    metres_of,
    numbers_of,
    of_projection,
)
from gsba.camera.fisheye import Rig, lens_names, rotation_of, three
from gsba.camera.lens import all_centres
from gsba.camera.projections import FisheyeProjection, RadialProjection, projection_of_model
from gsba.geometry import pose, unit
from gsba.log import GsbaError
from gsba.types import Fisheye

_MODEL = "kannala-brandt: r = f (th + k1 th^3 + k2 th^5 + k3 th^7 + k4 th^9), corner origin"
_EXPECTED_FORM = (
    "give lenses.front and lenses.back, or lenses.lens0, lenses.lens1 and so on, each with "
    "width, height, f, cx, cy, k and rig_T_lens, a Kalibr camchain of cam0 and cam1, or a COLMAP "
    "rig"
)
_MAX_FILE_BYTES = 1 << 18  # YAML takes a second for each hundred thousand
_MAX_UNSEEN_ANGLE_RAD = np.deg2rad(95.0)  # of a direction from the nearest of more than two axes
_DIRECTIONS = unit(np.stack(np.meshgrid(*3 * [np.linspace(-1, 1, 12)]), axis=-1).reshape(-1, 3))
# (N, 3) float64, all around
_MAX_AXIS_ANGLE_RAD = np.deg2rad(20.0)  # between a lens's axis and the rig's z axis


def read_calibration(path: Path) -> Rig:
    """The lenses that a file describes, or the folder of a COLMAP model. GsbaError: the file is
    unreadable, or its lenses do not look all around."""
    try:
        rig = (
            from_colmap_model(path) if path.is_dir() else _lenses_of_tree(_parsed_file(path), path)
        )
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        why = kind + _one_line(error)
        if isinstance(error, KeyError):
            why = f"it has no {error}"
        raise GsbaError(f"{path}: not a calibration of lenses ({why}); {_EXPECTED_FORM}") from None
    try:
        axes = np.array([rotation_of(lens)[:, 2] for lens in rig])
        if len(rig) == 2 and min(axes[0, 2], -axes[1, 2]) < np.cos(_MAX_AXIS_ANGLE_RAD):
            raise ValueError(
                "the front lens must look along z of the rig and the back one the other way, "
                f"within {np.rad2deg(_MAX_AXIS_ANGLE_RAD):.0f} degrees: check their poses"
            )
        widest = np.arccos(np.clip((_DIRECTIONS @ axes.T).max(axis=1).min(), -1, 1))
        if len(rig) > 2 and widest > _MAX_UNSEEN_ANGLE_RAD:
            raise ValueError(
                f"a direction is {np.rad2deg(widest):.0f} degrees from every lens's axis; lenses "
                f"must see all around, to {np.rad2deg(_MAX_UNSEEN_ANGLE_RAD):.0f} degrees: check "
                "their poses"
            )
        middle = np.mean([lens.centre for lens in rig], axis=0)
        return tuple(replace(lens, centre=three(np.asarray(lens.centre) - middle)) for lens in rig)
    except ValueError as error:
        raise GsbaError(f"{path}: {error}") from None


def calibration_json(
    rig: Rig, centre: np.ndarray, unit: str, more: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of a calibration file of a rig, the front lens first; centre: (3 (L - 1),) of all
    but the last one, see `gsba.camera.lens.Lenses`, in a unit, "m" or "map"."""
    return {
        "model": _MODEL,
        "unit": unit,
        "lenses": {
            name: {
                "width": lens.width,
                "height": lens.height,
                "f": lens.focal,
                "cx": lens.principal[0],
                "cy": lens.principal[1],
                "k": list(lens.radial),
                "rig_T_lens": pose(rotation_of(lens), place).tolist(),
            }
            for name, lens, place in zip(
                lens_names(len(rig)), rig, all_centres(centre), strict=True
            )
        },
        **more,
    }


def scaled_to_size(rig: Rig, size: tuple[int, int], path: Path) -> Rig:
    """A calibration scaled to pictures of another size. GsbaError: it has another aspect ratio."""
    width, height = size
    for lens in rig:
        if abs(width * lens.height - height * lens.width) > 0.01 * width * lens.height:
            raise GsbaError(
                f"{path}: calibrates pictures of {lens.width}x{lens.height}, but these are "
                f"{width}x{height}: another aspect ratio; give the calibration of this video mode"
            )
    return tuple(
        replace(
            lens,
            width=width,
            height=height,
            focal=lens.focal * width / lens.width,
            principal=(
                lens.principal[0] * width / lens.width,
                lens.principal[1] * height / lens.height,
            ),
        )
        for lens in rig
    )


def _parsed_file(path: Path) -> Any:
    """The parsed content of a JSON or YAML file."""
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_FILE_BYTES + 1)
        if len(content) > _MAX_FILE_BYTES:
            raise GsbaError(f"{path}: is larger than any calibration, {_MAX_FILE_BYTES >> 10} kB")
        text = content.decode("utf-8")
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise GsbaError(f"{path}: is no text; give a calibration as JSON or YAML") from None
    try:
        if path.suffix.lower() in (".yaml", ".yml") or re.search(r"^cam\d+:", text, re.MULTILINE):
            return _yaml(text)
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise GsbaError(
            f"{path}: is neither JSON nor YAML ({_one_line(error)}); {_EXPECTED_FORM}"
        ) from None


def _yaml(text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """A loader without aliases: few of them can stand for gigabytes."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                mark = self.peek_event().start_mark
                raise ValueError(
                    f"line {mark.line + 1} holds an alias; write out what it stands for"
                )
            return super().compose_node(parent, index)

    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as error:
        raise ValueError(str(error)) from None


def _lenses_of_tree(tree: Any, path: Path) -> Rig:
    """The lenses, read in the form that the tree's keys show."""
    if isinstance(tree, list):
        return from_colmap_config(tree, path)
    fields_of(tree, (), "it")
    if "cameras" in tree:
        return from_colmap_config([tree], path)
    if any(re.fullmatch(r"cam\d+", str(name)) for name in tree):
        return from_kalibr(tree, path)
    metres = metres_of(tree.get("unit", "m"))
    (entries,) = fields_of(tree, ("lenses",), "it")
    model = projection_of_model(tree.get("model", _MODEL))
    names = lens_names(len(entries)) if "lens2" in entries else ("front", "back")
    lenses = fields_of(entries, names, "lenses")
    return tuple(
        _lens_of_entry(lens, metres, model, name, path)
        for lens, name in zip(lenses, names, strict=True)
    )


def _lens_of_entry(
    tree: Mapping[str, Any],
    metres: float,
    model: Callable[..., RadialProjection],
    name: str,
    path: Path,
) -> Fisheye:
    where = f"lenses.{name}"
    fields_of(tree, (), where)
    # A square picture may be given by its `size`.
    names = "width", "height"
    sides = [side if tree.get(side) or "size" not in tree else "size" for side in names]
    width, height, f, cx, cy = (
        float(numbers_of(tree, field, where, 1)[0]) for field in (*sides, "f", "cx", "cy")
    )
    rig_T_lens = numbers_of(tree, "rig_T_lens", where, 16).reshape(4, 4)
    rig_T_lens[:3, 3] *= metres
    if model is FisheyeProjection:
        terms = numbers_of(tree, "k", where).tolist()
        return lens_of((width, height), f, (cx, cy), terms, rig_T_lens)
    terms = tuple(numbers_of(tree, "k", where).tolist()) if "k" in tree else ()
    lens = model(int(width), int(height), f, (cx, cy), terms)
    return of_projection(lens, rig_T_lens, f"{path}: {name}")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
