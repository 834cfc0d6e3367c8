"""The cameras of a dataset's rigs, and the pixels in which they show what frames observe."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsba.camera.fisheye import facing, optical_axes, project, rotation_of
from gsba.camera.lens import Lenses
from gsba.camera.sphere import erp_from_bearings
from gsba.camera.views import View
from gsba.export.raw import SEEN_DEG, raw_lenses
from gsba.geometry import pose
from gsba.types import Fisheye, PictureFormat, Reconstruction


@dataclass(frozen=True, slots=True)
class RigSensor:
    """A camera of the rig."""

    model: str  # COLMAP's name
    width: int  # pixels
    height: int  # pixels
    params: tuple[float, ...]  # parameters of COLMAP's model, corner origin
    rig_T_sensor: np.ndarray  # (4, 4) float64
    fisheye: Fisheye | None = None  # lens of an OPENCV_FISHEYE camera


def pinholes(views: Sequence[Sequence[View]]) -> list[list[RigSensor]]:
    """The cameras of each rig."""

    def pinhole(view: View) -> RigSensor:
        params = (view.focal, view.focal, *view.principal)
        return RigSensor("PINHOLE", view.width, view.height, params, view.rig_T_view)

    return [list(map(pinhole, own)) for own in views]


def raw_sensors(kind: PictureFormat, lenses: Lenses) -> list[RigSensor]:
    """Raw lenses as cameras of the rig."""
    return [
        RigSensor(
            "OPENCV_FISHEYE",
            lens.width,
            lens.height,
            (lens.focal, lens.focal, *lens.principal, *lens.radial),
            pose(rotation_of(lens), centre),
            lens,
        )
        for lens, centre in zip(raw_lenses(kind), lenses.centres, strict=True)
    ]


def project_in_rigs(
    reconstruction: Reconstruction, rigs: Sequence[Sequence[RigSensor]], rig_of_frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) of its frame's rig that sees each observation, -1 = its camera model reaches less
    far, and its pixel (O, 2) there."""
    bearings, origins = reconstruction.observation_bearings, reconstruction.observation_origins
    which, pixels = np.zeros(len(bearings), np.int64), np.empty((len(bearings), 2))
    of_observation = rig_of_frame[reconstruction.observation_frames]
    for number, sensors in enumerate(rigs):
        rows = np.flatnonzero(of_observation == number)
        starts = None if origins is None else origins[rows]
        which[rows], pixels[rows] = _project(sensors, bearings[rows], starts)
    return which, pixels


def _project(
    sensors: Sequence[RigSensor], bearings: np.ndarray, origins: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) of the origin's lens that sees each bearing (O, 3) furthest from its border, and
    the pixel (O, 2) there."""
    if sensors[0].fisheye is not None:
        return _project_raw(sensors, bearings, origins)
    if sensors[0].model == "EQUIRECTANGULAR":
        pixels = erp_from_bearings(bearings, sensors[0].width, sensors[0].height)
        return np.zeros(len(bearings), np.int64), pixels
    found, off = np.empty((len(sensors), len(bearings), 2)), np.empty((len(sensors), len(bearings)))
    for c, sensor in enumerate(sensors):
        local = bearings @ sensor.rig_T_sensor[:3, :3]
        depths = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
        found[c] = sensor.params[:2] * local[:, :2] / depths + sensor.params[2:]
        half = np.array([sensor.width, sensor.height]) / 2
        off[c] = np.abs(found[c] / half - 1).max(axis=1)
        if origins is not None:
            off[c, origins[:, 2] * sensor.rig_T_sensor[2, 3] < 0] = np.nan  # the other lens
    which = np.argmin(np.where(np.isnan(off), np.inf, off), axis=0)
    return which, found[which, np.arange(len(bearings))]


def _project_raw(
    sensors: Sequence[RigSensor], bearings: np.ndarray, origins: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor (O,) and pixel (O, 2) of each bearing (O, 3) in the raw lenses; -1 beyond SEEN_DEG."""
    if origins is None:
        rig = tuple(sensor.fisheye for sensor in sensors if sensor.fisheye is not None)
        which = facing(bearings, optical_axes(rig))
    else:
        centres = np.array([sensor.rig_T_sensor[:3, 3] for sensor in sensors])
        apart = np.linalg.norm(origins[:, None] - centres, axis=2)
        which = np.argmin(apart, axis=1)
    pixels = np.empty((len(bearings), 2))
    for c, sensor in enumerate(sensors):
        assert sensor.fisheye is not None
        own = which == c
        pixels[own] = project(sensor.fisheye, bearings[own])
        far = bearings @ rotation_of(sensor.fisheye)[:, 2] < np.cos(np.deg2rad(SEEN_DEG))
        which[own & far] = -1
    return which, pixels
