"""Files of localised pictures: trajectory, table of poses with covariances, JSON."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsba.disk import write_csv, write_json
from gsba.geometry import quaternion_from_rotation
from gsba.localization.localizer import LocalizedFrame
from gsba.localization.photo_localizer import CameraOfPhotos, LocalizedPhotos
from gsba.localization.pictures import QueryPicture
from gsba.localization.run_map import RunMap
from gsba.store.finished import map_digest
from gsba.trajectory.files import write_tum
from gsba.types import Trajectory
from gsba.version import __version__

_AXES = ("rx", "ry", "rz", "x", "y", "z")
_UPPER = np.triu_indices(6)


def write_localized(
    folder: Path, map_: RunMap, found: LocalizedPhotos, pictures: Sequence[QueryPicture]
) -> None:
    """Write `trajectory.tum`, `poses.csv` and `localized.json`, each whole or not at all.

    The trajectory holds panoramas; photos, whose poses are those of their cameras, are in the other
    two.

    Covariances are of the tangent [rotation (radians), translation (map units)] in the picture's
    frame, given the map. Raises GsbaError: the disk cannot be written.
    """
    frames, times = found.frames, [picture.time for picture in pictures]
    rows = [n for n, frame in enumerate(frames) if frame.found and frame.camera is None]
    order = sorted(rows, key=lambda n: times[n])
    if len({times[n] for n in rows}) == len(rows):
        stamps = np.array([times[n] for n in order], np.float64)
    else:  # several sources: their order stands for times
        order, stamps = rows, np.array(rows, np.float64)
    poses = np.array([frames[n].world_T_rig for n in order]).reshape(-1, 4, 4)
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / "trajectory.tum", Trajectory(stamps, poses))
    header = ["picture", "timestamp", "status", "reason", "camera"]
    header += ["points", "noise_deg", "nearest_frame"]
    header += ["tx", "ty", "tz", "qw", "qx", "qy", "qz"]
    header += [f"cov_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True)]
    table = []
    for frame, time in zip(frames, times, strict=True):
        status = "localised" if frame.found else "refused"
        camera = "" if frame.camera is None else frame.camera
        row = [frame.name, repr(float(time)), status, frame.reason, camera]
        numbers = [""] * (len(header) - len(row))
        if frame.found:
            pose = frame.world_T_rig
            values = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
            values += [*frame.covariance[_UPPER]]
            numbers = [frame.num_points, f"{np.degrees(frame.noise_rad):.6g}"]
            numbers += [frame.nearest, *(f"{value:.15g}" for value in values)]
        table.append(row + numbers)
    write_csv(folder / "poses.csv", header, table)
    content = {
        "gsba": __version__,
        "run": str(map_.root.resolve()),
        "map": map_digest(map_.result, map_.frames),
        "pictures": [
            _as_json(frame, picture) for frame, picture in zip(frames, pictures, strict=True)
        ],
        "cameras": [_camera_json(camera) for camera in found.cameras],
    }
    write_json(folder / "localized.json", content)


def _as_json(frame: LocalizedFrame, picture: QueryPicture) -> dict[str, Any]:
    content: dict[str, Any] = {"name": frame.name, "timestamp": picture.time}
    content |= {"reason": frame.reason, "camera": frame.camera}
    if picture.path is not None:
        content["file"] = str(picture.path.resolve())
    if frame.found:
        content |= {
            "world_T_picture": frame.world_T_rig.tolist(),
            "covariance": frame.covariance.tolist(),
            "points": frame.num_points,
            "noise_deg": float(np.degrees(frame.noise_rad)),
            "nearest_frame": frame.nearest,
        }
    return content


def _camera_json(camera: CameraOfPhotos) -> dict[str, Any]:
    """Camera of photos: r = focal (t + k1 t^3 + k2 t^5), t the tangent of the angle to z."""
    projection = camera.projection
    sigmas = np.sqrt(np.maximum(np.diag(camera.covariance), 0)) * np.array(
        [projection.focal] * 3 + [1.0, 1.0]
    )
    return {
        "model": "perspective",
        "width": projection.width,
        "height": projection.height,
        "focal": projection.focal,
        "principal": list(projection.principal),
        "radial": list(projection.radial),
        "sigmas": sigmas.tolist(),
        "photos": list(camera.photos),
    }
