"""The walk as glTF 2.0, scene.glb: the cloud, a camera for each frame with a field of 90 degrees
across 16:9, and the camera `walk`, which moves through all frames at their times.

A world without a known vertical is turned by the axis nearest to the up axes of the rigs.
`open_in_blender.py` beside it reads `extras`: of the scene `fps`, `width` and `height`; of each
frame's node `frame`, its place on the timeline, and `picture`, the path of its panorama. `fps` is
an integer, as Blender 4.5 and 5.0 import times by fps * fps_base, and play them by fps / fps_base.
"""

import json
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsba.disk import write_bytes
from gsba.export.dataset import Dataset
from gsba.export.images import panorama_writers
from gsba.export.pictures import Files, FrameWriter
from gsba.geometry import CV_R_GL, extent_of, quaternion_from_rotation
from gsba.types import FrameSet, Reconstruction

_RIG_UP = np.array([0.0, -1, 0])  # of a camera that is held level
_FLOAT, _UBYTE, _POINTS = 5126, 5121, 0  # glTF's numbers of component types and modes
_SCRIPT = "open_in_blender.py"


def write_blender(data: Dataset) -> list[list[FrameWriter]]:
    """Write scene.glb and the script that opens it in Blender; returns the writer of panoramas, if
    they are wanted as backgrounds of the cameras."""
    files, frames = Files(data.folder, ("",), "images/{name}{suffix}", ""), data.frames
    panoramas = data.images == "panorama"
    pictures = [files.images(frames, f)[0] for f in range(len(frames))] if panoramas else None
    path = data.folder / "scene.glb"
    write_gltf(path, data.reconstruction, frames, data.placement.up, pictures)
    shutil.copyfile(Path(__file__).with_name(_SCRIPT), data.folder / _SCRIPT)
    if not panoramas:
        return []
    return [panorama_writers(data, files)]


def write_gltf(
    path: Path,
    reconstruction: Reconstruction,
    frames: FrameSet,
    up: str | None = None,
    pictures: Sequence[str] | None = None,
) -> None:
    """Write `path`, a binary glTF file.

    Args:
        up: axis of the world that points up, "-y", "y" or "z"; None = unknown.
        pictures: (F,) paths of the frames' panoramas, relative to the file's folder; None = there
            are none.

    Raises:
        GsbaError: the disk cannot be written.
    """
    gltf_R_world = _gltf_R_world(up, reconstruction.world_T_rigs)
    rotations = gltf_R_world @ reconstruction.world_T_rigs[:, :3, :3] @ CV_R_GL
    positions = reconstruction.world_T_rigs[:, :3, 3] @ gltf_R_world.T
    xyzw = _steady(quaternion_from_rotation(rotations))[:, [1, 2, 3, 0]]
    scene = _Buffer()
    nodes: list[dict[str, Any]] = [
        {"name": "walk", "camera": 0, **_placed(positions[0], xyzw[0])},
        *(
            {"name": name, "camera": 0, **_placed(at, turn), "extras": about}
            for name, at, turn, about in zip(
                frames.names, positions, xyzw, _extras(frames, pictures), strict=True
            )
        ),
    ]
    meshes = []
    if len(reconstruction.points_world):
        points = reconstruction.points_world @ gltf_R_world.T
        opaque = np.full((len(points), 1), 255, np.uint8)
        colors = np.hstack([reconstruction.point_colors, opaque])
        attributes = {"POSITION": scene.add(points, "VEC3"), "COLOR_0": scene.add(colors, "VEC4")}
        meshes = [{"name": "cloud", "primitives": [{"attributes": attributes, "mode": _POINTS}]}]
        nodes.append({"name": "cloud", "mesh": 0})
    walk = _walk(scene, frames.timestamps - frames.timestamps[0], positions, xyzw)
    about = {"fps": _fps(frames)}
    if pictures is not None:
        about |= {"width": frames.formats[0].width, "height": frames.formats[0].height}
    document = {
        "asset": {"version": "2.0", "generator": "gsba"},
        "scene": 0,
        "scenes": [{"name": "gsba", "nodes": list(range(len(nodes))), "extras": about}],
        "nodes": nodes,
        "cameras": [{"type": "perspective", "perspective": _perspective(reconstruction)}],
        "animations": [walk],
        **({"meshes": meshes} if meshes else {}),
        **scene.tables(),
    }
    # A JSON and a binary chunk, each padded to four bytes
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    content = bytes(scene.content) + b"\0" * (-len(scene.content) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(content), 0x004E4942) + content
    write_bytes(path, struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def _walk(
    scene: "_Buffer", seconds: np.ndarray, positions: np.ndarray, xyzw: np.ndarray
) -> dict[str, Any]:
    """Animation of node 0, through positions (F, 3) and quaternions (F, 4) at their times (F,)."""
    times = scene.add(seconds[:, None], "SCALAR")
    samplers = [
        {"input": times, "output": scene.add(values, kind), "interpolation": "LINEAR"}
        for values, kind in ((positions, "VEC3"), (xyzw, "VEC4"))
    ]
    channels = [
        {"sampler": number, "target": {"node": 0, "path": what}}
        for number, what in enumerate(("translation", "rotation"))
    ]
    return {"name": "walk", "channels": channels, "samplers": samplers}


def _perspective(reconstruction: Reconstruction) -> dict[str, float]:
    """Lens of the cameras; everything is between its near and its far plane."""
    centres = reconstruction.world_T_rigs[:, :3, 3]
    extent = max(float(np.ptp(centres, axis=0).max()), 1e-3)
    things = np.concatenate([centres, reconstruction.points_world])
    far = 10.0 * max(extent_of(things), extent)
    aspect = 16 / 9  # width to height of Blender's scenes
    yfov = 2 * np.arctan(1 / aspect)  # vertical field, for a horizontal one of 90 degrees
    return {"yfov": yfov, "aspectRatio": aspect, "znear": 1e-4 * extent, "zfar": far}


def _fps(frames: FrameSet) -> int:
    """Frames per second of a timeline on which each picture has a frame of its own."""
    shortest = float(np.diff(frames.timestamps).min(initial=1.0))
    fps = np.clip(np.ceil(1 / shortest - 1e-3), 24, 240)
    longest = float(frames.timestamps[-1] - frames.timestamps[0])
    # Blender's timeline ends at frame 1,048,574.
    return int(min(fps, max(1_000_000 // max(longest, 1.0), 1)))


def _extras(frames: FrameSet, pictures: Sequence[str] | None) -> list[dict[str, Any]]:
    """Entries (F,) of the frames for Blender: frame of the timeline, and picture."""
    places = np.rint((frames.timestamps - frames.timestamps[0]) * _fps(frames)).astype(int)
    order = np.arange(len(places))
    places = np.maximum.accumulate(places - order) + order  # each later than the one before
    entries: list[dict[str, Any]] = [{"frame": place} for place in places.tolist()]
    for entry, picture in zip(entries, pictures or (), strict=False):
        entry["picture"] = picture
    return entries


def _gltf_R_world(up: str | None, world_T_rigs: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) that turns the world's up axis to y, by quarter turns about its axes."""
    if up is None:
        common = (world_T_rigs[:, :3, :3] @ _RIG_UP).mean(axis=0)
        # the rigs have no up axis in common
        if np.linalg.norm(common) < 0.5:
            common = _RIG_UP
        axis = int(np.argmax(np.abs(common)))
        up = f"{'-' if common[axis] < 0 else ''}{'xyz'[axis]}"
    sign = -1.0 if up.startswith("-") else 1.0
    if up[-1] == "y":
        return np.diag([1.0, sign, sign])
    if up[-1] == "z":
        return np.array([[1.0, 0, 0], [0, 0, sign], [0, -sign, 0]])
    return np.array([[0, -sign, 0], [sign, 0, 0], [0, 0, 1.0]])


class _Buffer:
    """Content of the one binary buffer, with its views and accessors."""

    def __init__(self) -> None:
        self.content = bytearray()
        self._views: list[dict[str, int]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, values: np.ndarray, kind: str) -> int:
        """Number of the accessor of new values (N, D): uint8 colours, else float32."""
        is_color = values.dtype == np.uint8
        values = values if is_color else values.astype("<f4")
        view = {"buffer": 0, "byteOffset": len(self.content), "byteLength": values.nbytes}
        accessor = {"bufferView": len(self._views), "count": len(values), "type": kind}
        accessor |= {"componentType": _UBYTE if is_color else _FLOAT}
        if is_color:
            accessor["normalized"] = True
        else:
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.content += values.tobytes()
        self._views.append(view)
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def tables(self) -> dict[str, Any]:
        """The document's tables of the buffer."""
        buffers = [{"byteLength": len(self.content)}]
        return {"buffers": buffers, "bufferViews": self._views, "accessors": self._accessors}


def _placed(position: np.ndarray, xyzw: np.ndarray) -> dict[str, list[float]]:
    return {"translation": position.tolist(), "rotation": xyzw.tolist()}


def _steady(wxyz: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) with the signs that make each step a turn of less than 180 degrees."""
    flips = np.where(np.sum(wxyz[1:] * wxyz[:-1], axis=1) < 0, -1.0, 1.0)
    return wxyz * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
