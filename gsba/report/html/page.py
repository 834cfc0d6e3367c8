"""The report page: style, script and data in one file that needs no network."""

import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from gsba.camera.cameras import ONE_CAMERA, Cameras
from gsba.disk import write_text
from gsba.log import GsbaError
from gsba.odometry import Odometry
from gsba.report.html import figures, pictures
from gsba.report.html.figures import odometry_plan
from gsba.report.html.patches import worst_patches
from gsba.report.html.pictures import jpeg_text
from gsba.report.html.thumbnails import frame_pictures
from gsba.report.report import frame_quality, plain
from gsba.types import CoarsePoses, FrameSet, Reconstruction

logger = logging.getLogger(__name__)

_PARTS = {
    "/*STYLE*/": ("style.css",),
    "/*SCRIPT*/": ("base.js", "terms.js", "charts.js", "verdict.js", "frames.js", "main.js"),
}
_SPLAT_WIDTH = 1080  # pixels of six faces in a row
_DATA = "/*DATA*/"
_BEFORE_DATA, _AFTER_DATA = '<script type="application/json" id="data">', "</script>"


def write_html(
    path: Path,
    frames: FrameSet,
    coarse: CoarsePoses,
    reconstruction: Reconstruction,
    report: Mapping[str, Any],
    cameras: Cameras = ONE_CAMERA,
) -> None:
    """Write the page of a run: poses before and after, residuals, costs.

    Args:
        frames: frames of the run; the page holds small images of the worst ones.
        report: content of report.json.
        cameras: lenses of the frames, in the unit of the reconstruction.
    """
    found, worst = [], pictures.worst_frames(reconstruction)
    for f in worst:
        try:
            found.append(pictures.picture(frames, reconstruction, f))
        except GsbaError as error:
            logger.warning("report.html: no image of frame %s (%s)", frames.names[f], error)
    data = {
        "run": path.resolve().parent.name,
        "report": {name: value for name, value in report.items() if name != "residual_sphere"},
        "map": figures.world_map(coarse, reconstruction),
        "frames": _frames(frames, coarse, reconstruction),
        "matches": figures.match_matrix(reconstruction),
        "sphere": report["residual_sphere"],
        "field": figures.field_sphere(frames.formats[0].correction),
        "erp_width": max(kind.panorama_width for kind in frames.formats),
        "recordings": list(frames.recordings),
        "worst": found,
        "patches": worst_patches(frames, reconstruction, cameras, worst),
        "pictures": frame_pictures(frames, reconstruction, report.get("camera")),
        "scan": None,
        "splat": None,
        "odometry": None,
    }
    with suppress(OSError, ValueError, KeyError, TypeError):  # there is no earlier page
        earlier = _read(path)
        if earlier["map"] == json.loads(_dumped(data["map"])):  # of the same poses and points
            data |= {name: earlier[name] for name in ("scan", "splat")}
    write_text(path, _assembled(_dumped(data)))


def add_scan(path: Path, content: Mapping[str, Any]) -> None:
    """Add distances to a scan to a run's page.

    Args:
        content: content of scan.json.

    Raises:
        GsbaError: the file is no page of a run, or cannot be written.
    """
    shown = {name: content[name] for name in ("scan", "before", "after") if name in content}
    _add(path, "scan", shown)


def add_splats(path: Path, picture: Path, sources: Sequence[str]) -> None:
    """Add a held-out frame and its renderings to a run's page, to be compared by a slider: after
    refinement over before, or the splat over the frame where there is no other.

    Args:
        picture: rows of faces, of the frame and of the splat of each source, see
            `gsba.evaluate.splats.compare`; its name is that of the frame.
        sources: names of the sources, that on the run's poses first.

    Raises:
        GsbaError: the file is no page of a run, or cannot be written.
    """
    import cv2

    image = np.asarray(cv2.imread(str(picture)))[..., ::-1]
    size = _SPLAT_WIDTH, round(len(image) / (1 + len(sources)) / image.shape[1] * _SPLAT_WIDTH)
    rows = np.split(image, 1 + len(sources))
    beside = [f"splat on {name} poses" for name in sources]
    shown = [("captured", rows[0]), (beside[0], rows[1])]
    if len(rows) > 2:
        shown = [(beside[1], rows[2]), (beside[0], rows[1])]
    pictures_of = [
        {"name": name, "jpeg": jpeg_text(cv2.resize(row, size, interpolation=cv2.INTER_AREA), [80])}
        for name, row in shown
    ]
    _add(path, "splat", {"frame": picture.stem, "size": size, "pictures": pictures_of})


def add_odometry(path: Path, found: Odometry) -> None:
    """Add a video's odometry to a run's page: maps from above, keyframes, loops, losses. Raises
    GsbaError: the file is no page of a run, or cannot be written."""
    _add(path, "odometry", odometry_plan(found))


def _add(path: Path, name: str, content: Mapping[str, Any]) -> None:
    """Add data to a page under a name; nothing is done if there is no page."""
    if not path.exists():
        return
    try:
        data = _read(path)
        data[name] = content
    except (OSError, ValueError, KeyError, TypeError):
        raise GsbaError(f"{path} is not the report page of a run: refine again") from None
    write_text(path, _assembled(_dumped(data)))


def _read(path: Path) -> dict[str, Any]:
    """Data of a page. Raises OSError, ValueError: it cannot be read, or holds none."""
    text = path.read_text(encoding="utf-8")
    return json.loads(text.partition(_BEFORE_DATA)[2].partition(_AFTER_DATA)[0])


def _dumped(data: Mapping[str, Any]) -> str:
    return json.dumps(plain(data, digits=6), allow_nan=False, separators=(",", ":"))


def _assembled(data: str) -> str:
    """Page from the template and its parts; `<` is escaped, so that data cannot end its element."""
    folder = files("gsba.report.html")
    text = (folder / "template.html").read_text(encoding="utf-8")
    for mark, names in _PARTS.items():
        parts = [(folder / name).read_text(encoding="utf-8") for name in names]
        text = text.replace(mark, "\n".join(parts))
    return text.replace(_DATA, data.replace("<", "\\u003c"))


def _frames(
    frames: FrameSet, coarse: CoarsePoses, reconstruction: Reconstruction
) -> dict[str, Any]:
    """Values of all frames, by column."""
    quality = frame_quality(reconstruction)
    moved, turned = figures.displacements(coarse, reconstruction)
    return {
        "name": frames.names,
        "recording": frames.recording_of_frame,
        "time": frames.timestamps,
        "source": coarse.sources,
        "status": reconstruction.pose_statuses,
        "moved": moved,
        "turned_deg": turned,
        "residual_deg": quality.median_residuals_deg,
        "observations": quality.num_observations,
        "std_deg": np.linalg.norm(quality.std_rotations_deg, axis=1),
        "std": np.linalg.norm(quality.std_translations, axis=1),
    }
