"""Calibrations of a raw pair by other programs: a Kalibr camchain, a COLMAP rig. z is halfway
between the front lens's axis and the back one's reversed; x is the front picture's, across z."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.fisheye import Pair, three
from gsba.camera.projections import RadialProjection
from gsba.geometry import inverse, pose, rotation_from_quaternion
from gsba.log import GsbaError, brief
from gsba.types import Fisheye

_log = logging.getLogger(__name__)

_MAX_LOG_RATIO = 0.01  # largest logarithm of the ratio of a camera's two focal lengths
_MAX_ANGLE_RAD = np.deg2rad(95.0)  # largest angle from a lens's axis at which its model must
# hold
_MAX_FIT_ERROR_PX = 0.1  # largest difference to another camera model after fitting ours
_COLMAP_MODEL = "OPENCV_FISHEYE"
_METRES_OF_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "map": 0.0}


def lens_of(
    size: Sequence[Any],
    focal: Any,
    principal: Sequence[Any],
    radial: Sequence[Any],
    rig_T_lens: np.ndarray | None = None,
) -> Fisheye:
    """A lens built from the numbers of a file: size, focal length in pixels per radian, principal
    point in pixels, corner origin, up to four radial terms, of the odd powers from the third on,
    and its pose (4, 4), metres; None = it is the rig. Raises ValueError: the values are no numbers,
    or no lens has them."""
    from scipy.spatial.transform import Rotation

    width, height = (int(pixels) for pixels in size)
    (x, y), terms, f = (float(v) for v in principal), [float(k) for k in radial], float(focal)
    if len(terms) > 4 or not np.isfinite([f, x, y, *terms]).all() or min(f, width, height) <= 0:
        raise ValueError("f, cx, cy, up to four k and the size must be numbers, f above 0")
    if not (0 < x < width and 0 < y < height):
        raise ValueError(
            f"the principal point ({x:g}, {y:g}) is outside the picture of {width}x{height}"
        )
    k1, k2, k3, k4 = [*terms, 0.0, 0.0, 0.0, 0.0][:4]
    squares = np.linspace(0, _MAX_ANGLE_RAD, 200) ** 2
    if (np.polyval([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0], squares) <= 0).any():
        raise ValueError(
            f"r(theta) of k {terms} does not grow up to {np.rad2deg(_MAX_ANGLE_RAD):.0f} degrees"
        )
    turn, place = np.zeros(3), np.zeros(3)
    if rig_T_lens is not None:
        turn = Rotation.from_matrix(_checked_rigid(rig_T_lens)[:3, :3]).as_rotvec()
        place = rig_T_lens[:3, 3]
    return Fisheye(width, height, f, (x, y), (k1, k2, k3, k4), three(turn), three(place))


def metres_of(unit: Any) -> float:
    """Metres in a unit that a file names; 0 for "map", whose lengths have no known scale.
    ValueError: the unit is not known."""
    if not isinstance(unit, str) or unit not in _METRES_OF_UNIT:
        raise ValueError(f"unit {brief(repr(unit))} is not known: use {', '.join(_METRES_OF_UNIT)}")
    return _METRES_OF_UNIT[unit]


def fields_of(tree: Any, names: Sequence[str], where: str) -> list[Any]:
    """Values of named fields of a group, as JSON or YAML gives it; where: the group's name in the
    file. Raises ValueError: this is no group of fields, or one is missing; the message names it."""
    if not isinstance(tree, Mapping):
        raise ValueError(f"{where} is {brief(repr(tree))}, not a group of fields")
    for name in names:
        if name not in tree:
            raise ValueError(f"{where} has no {name}")
    return [tree[name] for name in names]


def numbers_of(tree: Any, name: str, where: str, count: int | None = None) -> np.ndarray:
    """Numbers (N,) float64 of a field of a file, see `fields_of`; nested lists are joined.
    ValueError: the field is missing, or is not `count` finite numbers; the message names it."""
    (value,) = fields_of(tree, (name,), where)
    try:
        found = np.array(value, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        found = np.full(1, np.nan)
    if not np.isfinite(found).all() or count not in (None, len(found)):
        wanted = {None: "numbers", 1: "a number"}.get(count, f"{count} numbers")
        raise ValueError(f"{where}: {name} is {brief(repr(value))}, not {wanted}")
    return found


def from_kalibr(tree: Mapping[str, Any], path: Path) -> Pair:
    """The lenses of a camchain: `cam0` is the front one, `cam1` the back one.

    Raises:
        GsbaError: the file holds other cameras than these two.
        KeyError, TypeError, ValueError, IndexError: a field is missing, or is something else.
    """
    cameras = sorted(name for name in map(str, tree) if re.fullmatch(r"cam\d+", name))
    if cameras != ["cam0", "cam1"]:
        raise GsbaError(
            f"{path}: holds {', '.join(cameras)}; of a raw pair there are cam0, which is taken for "
            "the front lens, and cam1: calibrate these two"
        )
    front, back = (_kalibr_lens(tree[name], f"{path}: {name}") for name in cameras)
    cam1_T_cam0 = numbers_of(tree["cam1"], "T_cn_cnm1", "cam1", 16).reshape(4, 4)
    return _in_rig((front, back), inverse(_checked_rigid(cam1_T_cam0)), path)


def from_colmap_config(tree: Sequence[Any], path: Path) -> Pair:
    """The lenses of one rig of a `rig_config.json`: its `ref_sensor` is the front lens.

    COLMAP takes pictures' sizes from the pictures; here `width` and `height` stand beside
    `camera_params`. Lengths are metres, unless the rig names a `unit`, see `metres_of`.

    Raises:
        GsbaError: the file holds other cameras than these two.
        KeyError, TypeError, ValueError, IndexError: a field is missing, or is something else.
    """
    cameras = []
    for rig in tree:
        (listed,) = fields_of(rig, ("cameras",), "a rig")
        if not isinstance(listed, Sequence) or isinstance(listed, str):
            raise ValueError(f"cameras of a rig is {brief(repr(listed))}, not a list")
        cameras += listed
    for camera in cameras:
        fields_of(camera, (), "a camera")
    fronts = [camera for camera in cameras if camera.get("ref_sensor")]
    backs = [camera for camera in cameras if not camera.get("ref_sensor")]
    if len(tree) != 1 or len(fronts) != 1 or len(backs) != 1:
        raise GsbaError(
            f"{path}: holds {len(cameras)} cameras in {len(tree)} rigs, {len(fronts)} of them a "
            "ref_sensor; of a raw pair there is one rig of two, and the front lens is its "
            "ref_sensor"
        )
    lenses, poses = [], []
    for name, camera in zip(("front", "back"), (fronts[0], backs[0]), strict=True):
        if "width" not in camera or "height" not in camera:
            raise GsbaError(
                f"{path}: gives no picture size for the {name} lens: write width "
                "and height, pixels, beside its camera_params"
            )
        where = f"the {name} lens"
        size = [numbers_of(camera, side, where, 1)[0] for side in ("width", "height")]
        (model,) = fields_of(camera, ("camera_model_name",), where)
        params = numbers_of(camera, "camera_params", where).tolist()
        lenses.append(_colmap_lens(model, size, params, f"{path}: {name} lens"))
        wxyz = np.array(camera.get("cam_from_rig_rotation", (1, 0, 0, 0)), dtype=np.float64)
        at = np.array(camera.get("cam_from_rig_translation", (0, 0, 0)), dtype=np.float64)
        if wxyz.shape != (4,) or at.shape != (3,) or not 0.9 < np.linalg.norm(wxyz) < 1.1:
            raise ValueError("cam_from_rig must be a quaternion wxyz and three numbers")
        if name == "back" and "cam_from_rig_rotation" not in camera:
            raise ValueError(f"{where} has no cam_from_rig_rotation")
        poses.append(pose(rotation_from_quaternion(wxyz / np.linalg.norm(wxyz)), at))
    front_T_back = _checked_rigid(poses[0]) @ inverse(_checked_rigid(poses[1]))
    front_T_back[:3, 3] *= metres_of(tree[0].get("unit", "m"))
    return _in_rig((lenses[0], lenses[1]), front_T_back, path)


def from_colmap_model(folder: Path) -> Pair:
    """The lenses of a sparse model with one rig of two cameras, whose reference is the front one.

    A model's scale is arbitrary, so that the baseline between the lenses is not taken from it.

    Raises:
        GsbaError: no model can be read, or it holds other cameras than these two.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError, KeyError, MemoryError) as error:
        why = str(error).splitlines()[0].rpartition("] ")[2] if str(error) else "damaged"
        raise GsbaError(
            f"{folder}: is no COLMAP model that can be read ({why}); give the folder that holds "
            "rigs, cameras, frames, images and points3D, .bin or .txt"
        ) from None
    rigs = list(model.rigs.values())
    others = [dict(rig.non_ref_sensors) for rig in rigs]
    if len(rigs) != 1 or len(others[0]) != 1:
        raise GsbaError(
            f"{folder}: holds {len(model.cameras)} cameras in {len(rigs)} rigs; of a raw pair "
            "there is one rig of two, whose reference is the front lens (COLMAP's rig_configurator)"
        )
    ((sensor, back_from_front),) = others[0].items()
    if back_from_front is None:
        raise GsbaError(f"{folder}: gives no pose of the back lens relative to the front one")
    lenses = []
    for name, index in (("front", rigs[0].ref_sensor_id.id), ("back", sensor.id)):
        camera, where = model.cameras[index], f"{folder}: {name} lens"
        size = camera.width, camera.height
        lenses.append(_colmap_lens(camera.model.name, size, list(camera.params), where))
    rotation = back_from_front.rotation.matrix().T
    _log.info("%s: a COLMAP model has no metric scale: its baseline is not used", folder)
    return _in_rig((lenses[0], lenses[1]), pose(rotation, np.zeros(3)), folder)


def _kalibr_lens(tree: Mapping[str, Any], where: str) -> Fisheye:
    """A camera of a camchain as the rig; Kalibr's pixel centres are whole numbers."""
    name = where.rpartition(": ")[2]
    model, distortion = fields_of(tree, ("camera_model", "distortion_model"), name)
    kind = str(model), str(distortion)
    numbers = numbers_of(tree, "intrinsics", name).tolist()
    terms = numbers_of(tree, "distortion_coeffs", name).tolist()
    wanted = {("pinhole", "equidistant"): 4, ("omni", "radtan"): 5}.get(kind)
    if wanted is None:
        raise GsbaError(
            f"{where} is {kind[0]} with {kind[1]}; it must be pinhole with equidistant (Kalibr's "
            "model pinhole-equi): calibrate with that"
        )
    if len(numbers) != wanted or len(terms) != 4:
        raise ValueError(f"{name} needs {wanted} intrinsics and 4 distortion_coeffs")
    *xi, fu, fv, pu, pv = numbers
    size = numbers_of(tree, "resolution", name, 2).tolist()
    focal, principal = _focal(fu, fv, where), (pu + 0.5, pv + 0.5)
    if kind[0] == "pinhole":
        return lens_of(size, focal, principal, terms)
    return _fit_to_omni(size, (xi[0], focal), principal, terms, where)


def _colmap_lens(model: str, size: Sequence[Any], params: Sequence[Any], where: str) -> Fisheye:
    if model != _COLMAP_MODEL:
        raise GsbaError(f"{where} is {model}, but must be {_COLMAP_MODEL}: calibrate with that")
    fx, fy, cx, cy, *terms = (float(v) for v in params)
    if len(terms) != 4:
        raise ValueError(f"{_COLMAP_MODEL} has fx, fy, cx, cy, k1, k2, k3, k4")
    return lens_of(size, _focal(fx, fy, where), (cx, cy), terms)


def _focal(across: float, down: float, where: str) -> float:
    """The geometric mean of two focal lengths that hardly differ, pixels."""
    if not (across > 0 and down > 0):
        raise ValueError("focal lengths must be above 0")
    if abs(np.log(across / down)) > _MAX_LOG_RATIO:
        raise GsbaError(
            f"{where} has focal lengths {across:g} and {down:g}, more than "
            f"{100 * _MAX_LOG_RATIO:.0f} % apart, but pixels are assumed to be square; calibrate "
            "again"
        )
    return float(np.sqrt(across * down))


def _fit_to_omni(
    size: Sequence[Any],
    intrinsics: tuple[float, float],
    principal: tuple[float, float],
    distortion: Sequence[float],
    where: str,
) -> Fisheye:
    """Our model fitted to Mei and Rives's (ICRA 2007) with distortion k1, k2, p1, p2."""
    (xi, focal), (k1, k2, p1, p2) = intrinsics, distortion
    angles, around = np.meshgrid(np.linspace(0, _MAX_ANGLE_RAD, 96), np.arange(24) * np.pi / 12)
    angles, around = angles.ravel(), around.ravel()
    away = np.stack([np.cos(around), np.sin(around)], axis=1)
    depths = np.cos(angles) + xi
    if not depths.min() > 0:
        raise GsbaError(
            f"{where}: its omni model ends before {np.rad2deg(_MAX_ANGLE_RAD):.0f} degrees"
        )
    x, y = (plane := (np.sin(angles) / depths)[:, None] * away).T
    squares = x * x + y * y
    bent = plane * (1 + k1 * squares + k2 * squares**2)[:, None]
    bent[:, 0] += 2 * p1 * x * y + p2 * (squares + 2 * x * x)
    bent[:, 1] += p1 * (squares + 2 * y * y) + 2 * p2 * x * y
    (f, *terms), (dx, dy), worst = _fitted(angles, away, focal * bent)
    if not worst <= _MAX_FIT_ERROR_PX:
        raise GsbaError(
            f"{where} is omni with radtan, {worst:.2f} pixels from the best fit of our lens "
            f"model within {np.rad2deg(_MAX_ANGLE_RAD):.0f} degrees: calibrate with "
            "Kalibr's model pinhole-equi"
        )
    return lens_of(size, f, (principal[0] + dx, principal[1] + dy), np.array(terms) / f)


def of_projection(lens: RadialProjection, rig_T_lens: np.ndarray, where: str) -> Fisheye:
    """Our lens model fitted to a lens of another projection at rig_T_lens (4, 4), metres; where:
    file and projection, for error messages.

    Raises:
        GsbaError: the projection is not close to any lens of our model.
    """
    angles = np.linspace(0, min(_MAX_ANGLE_RAD, lens.max_angle), 200)
    away = np.tile([1.0, 0.0], (len(angles), 1))
    shown = (lens.focal * lens.radii(angles)[0])[:, None] * away
    (f, *terms), _, worst = _fitted(angles, away, shown)
    if not worst <= _MAX_FIT_ERROR_PX:
        raise GsbaError(
            f"{where}: {worst:.2f} pixels from the best fit of r = f (a + k1 a^3 + ... + k4 a^9) "
            f"within {np.rad2deg(angles[-1]):.0f} degrees of the axis: give f and k of that formula"
        )
    size = lens.width, lens.height
    return lens_of(size, f, lens.principal, np.array(terms) / f, rig_T_lens)


def _fitted(
    angles: np.ndarray, away: np.ndarray, shown: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Our model fitted to pixels (N, 2) of rays: focal length and its products with k1 to k4 (5,),
    the principal point's shift (2,), and the largest distance, pixels.
    """
    powers = angles[:, None] ** np.array([1, 3, 5, 7, 9])
    radial = (away[:, :, None] * powers[:, None]).reshape(-1, 5)
    columns = np.hstack([radial, np.tile(np.eye(2), (len(angles), 1))])
    found, *_ = np.linalg.lstsq(columns, shown.ravel())
    off = (columns @ found - shown.ravel()).reshape(-1, 2)
    return found[:5], found[5:], float(np.hypot(*off.T).max())


def _checked_rigid(a_T_b: np.ndarray) -> np.ndarray:
    """A pose (4, 4), checked to be a rigid motion."""
    turn = a_T_b[:3, :3]
    small = bool((np.abs(a_T_b) < 1e6).all())  # in any unit; no NaN either
    if not small or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3:
        raise ValueError("the pose of a lens is no rigid motion")
    if np.linalg.det(turn) < 0:
        raise ValueError("the pose of a lens mirrors")
    return a_T_b


def _in_rig(pair: Pair, front_T_back: np.ndarray, path: Path) -> Pair:
    """Both lenses in a rig at the front lens's centre, z between their axes."""
    from scipy.spatial.transform import Rotation

    axis = np.array([0.0, 0, 1]) - front_T_back[:3, 2]
    if axis[2] < 1:
        raise GsbaError(
            f"{path}: its two lenses look less than 90 degrees apart; those of a raw pair look "
            "away from one another"
        )
    ahead = axis / np.linalg.norm(axis)
    right = np.array([1.0, 0, 0]) - ahead[0] * ahead
    right /= np.linalg.norm(right)
    rig_R_front = np.stack([right, np.cross(ahead, right), ahead])
    turns = rig_R_front, rig_R_front @ front_T_back[:3, :3]
    places = np.zeros(3), rig_R_front @ front_T_back[:3, 3]
    front, back = (
        replace(lens, rotation=three(Rotation.from_matrix(turn).as_rotvec()), centre=three(place))
        for lens, turn, place in zip(pair, turns, places, strict=True)
    )
    return front, back
