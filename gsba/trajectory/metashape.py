"""Camera poses from Agisoft Metashape's cameras.xml: `chunk_T_camera`, row by row, axes as in our
rig. Cameras have labels in place of times; each component is a trajectory with a world of its
own."""

import logging
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba.frames.times import stem_of
from gsba.geometry import as_rotations, pose
from gsba.log import GsbaError, brief
from gsba.types import FrameSet, Trajectory

_log = logging.getLogger(__name__)

_FORMAT = "export the aligned panoramas by File > Export > Export Cameras, Agisoft XML"


@dataclass(frozen=True, slots=True)
class NamedPoses:
    """Poses of one component's cameras."""

    path: Path  # of the file, for messages
    names: tuple[str, ...]  # file names of images without suffix
    world_T_rigs: np.ndarray  # (N, 4, 4) float64, chunk units

    def timed(self, frames: FrameSet) -> Trajectory:
        """The poses of frames with these names, with `_` for folders, at the frames' times;
        GsbaError if fewer than two have one."""
        rows = {name: row for row, name in enumerate(self.names)}
        named = [name if name in rows else name.replace("/", "_") for name in frames.names]
        known = [(f, rows[name]) for f, name in enumerate(named) if name in rows]
        if len(known) < 2:
            raise GsbaError(
                f"{self.path}: {len(known)} of {len(self.names)} cameras are frames of this run: "
                f"its first camera is '{brief(self.names[0])}', the first frame "
                f"'{brief(frames.names[0])}'; give the pictures that were aligned"
            )
        _log.info("%s: poses of %d of %d frames", self.path, len(known), len(frames))
        at, chosen = (list(column) for column in zip(*known, strict=True))
        return Trajectory(frames.timestamps[at], self.world_T_rigs[chosen])


def is_metashape(path: Path) -> bool:
    """True if a file is XML by its first letter that is no blank."""
    try:
        with path.open("rb") as file:
            return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    except OSError:
        return False  # whoever reads it says why


def read_metashape(path: Path) -> list[NamedPoses]:
    """Poses of the aligned spherical cameras of a cameras.xml, by component, the largest first.
    Raises GsbaError: the file is damaged or of another program, no spherical camera is aligned, or
    two cameras have one name."""
    try:
        root = ET.parse(path).getroot()
    except OSError as error:
        raise GsbaError(f"{path}: cannot be read ({error.strerror or error})") from None
    except ET.ParseError as error:
        raise GsbaError(f"{path}: damaged XML ({error})") from None
    chunk = root.find("chunk")
    sensors = () if chunk is None else chunk.findall("sensors/sensor")
    if chunk is None or not sensors:
        raise GsbaError(f"{path}: not Metashape's cameras.xml: {_FORMAT}")
    spherical = {one.get("id") for one in sensors if one.get("type") == "spherical"}
    if not spherical:
        kinds = ", ".join(sorted({one.get("type") or "unknown" for one in sensors}))
        raise GsbaError(
            f"{path}: its cameras are of type {kinds}, and a pose of a frame needs type spherical: "
            f"set it in Tools > Camera Calibration, or {_FORMAT}"
        )
    found: dict[str, dict[str, np.ndarray]] = {}
    for camera in chunk.iterfind("cameras//camera"):
        transform, label = camera.findtext("transform"), camera.get("label") or ""
        if transform is None or camera.get("sensor_id") not in spherical:
            continue
        name = stem_of(label)
        if any(name in component for component in found.values()):
            raise GsbaError(f"{path}: two cameras are named '{brief(label)}': rename one")
        where = f"{path}: camera '{brief(label)}'"
        of_component = found.setdefault(camera.get("component_id") or "", {})
        # World_T_rig (4, 4) from 16 numbers, row by row.
        try:
            matrix = np.array(transform.split(), np.float64).reshape(4, 4)
        except ValueError:
            raise GsbaError(f"{where}: its transform is not 16 numbers") from None
        if not np.isfinite(matrix).all():
            raise GsbaError(f"{where}: its transform is not finite")
        rotation, is_one = as_rotations(matrix[:3, :3])
        if not is_one:
            raise GsbaError(f"{where}: the left 3x3 block of its transform is not a rotation")
        of_component[name] = pose(rotation, matrix[:3, 3])
    if not found:
        raise GsbaError(f"{path}: none of its spherical cameras is aligned: align them first")
    largest_first = sorted(found.values(), key=len, reverse=True)
    return [NamedPoses(path, tuple(one), np.stack(list(one.values()))) for one in largest_first]
