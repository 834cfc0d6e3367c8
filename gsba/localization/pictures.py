"""Pictures to localise: files, folders and videos, as panoramas or as photos."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsba import video
from gsba.config import VideoSettings
from gsba.frames.files import decode, image_size, is_image
from gsba.frames.scan import scan
from gsba.frames.side_by_side import lens_sizes
from gsba.frames.times import frame_times
from gsba.localization.picture_cameras import PictureCameras, raw_sizes
from gsba.log import GsbaError
from gsba.types import FrameSet


@dataclass(frozen=True, slots=True)
class QueryPicture:
    """A picture to localise."""

    name: str  # without folder and extension
    time: float  # seconds; the number of the picture where nothing gives times
    path: Path | None  # a 2:1 panorama or a photo; None = a frame of `frames`
    frames: FrameSet | None = None  # frames of several images each, in the layout of the run's
    frame: int = 0  # its number among them
    camera: int = 0  # of the run, that took these frames
    photo: bool = False  # True = a perspective photo


def load_panorama(path: Path, at_least: int) -> np.ndarray:
    """A panorama (H, 2H, 3) uint8 RGB, JPEGs decoded at a part of their width that is `at_least`
    enough; GsbaError if it cannot be read, or is not 2:1."""
    width, height = image_size(path)
    if width != 2 * height:
        raise GsbaError(f"{path}: is {width}x{height}; a panorama is 2:1")
    return decode(path, (width, height), at_least=at_least)


def find_pictures(
    sources: Sequence[Path], cameras: PictureCameras, work: Path
) -> list[QueryPicture]:
    """The pictures of files, folders and videos (one frame a second, in `work`), in this order;
    GsbaError for a source that holds none, frames of no camera of the run, or two of one name."""
    found: list[QueryPicture] = []
    for number, source in enumerate(sources):
        if not source.exists():
            raise GsbaError(f"{source}: no such file or folder")
        if video.is_video(source):
            folder = work / f"frames-{source.stem}" if number else work / "frames"
            video.extract(source, folder, VideoSettings())
            source = folder
        if source.is_dir() and not _is_of_single_images(source, cameras):
            found += _frames_of_several_images(source, cameras)
        else:
            found += _single_images(source, "erp" in cameras.layouts())
    for name, count in Counter(picture.name for picture in found).items():
        if count > 1:
            raise GsbaError(f"two pictures are named '{name}': localise them in two calls")
    return found


def _images(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and is_image(path))


def _is_of_single_images(folder: Path, cameras: PictureCameras) -> bool:
    """True if a folder's pictures are a file each: no pairs, nor faces or tracks in folders."""
    layouts = cameras.layouts()
    if layouts == {"erp"}:
        return True
    images = list(filter(_size_of, _images(folder)))
    if not images or layouts.isdisjoint(("erp", "cube")):
        return False
    size = image_size(images[0])
    sizes = lens_sizes(size)
    if not cameras.those(lambda kind: not set(raw_sizes(kind)).isdisjoint(sizes)):
        return True
    if not cameras.those(lambda kind: (kind.layout, kind.width, kind.height) == ("erp", *size)):
        return False
    return scan(folder, order_suffices=True, min_frames=1).format.layout == "erp"


def _single_images(source: Path, stitched: bool) -> list[QueryPicture]:
    """Panoramas or photos, one file each; 2:1 pictures are panoramas where the run has such."""

    def picture(path: Path, time: float) -> QueryPicture:
        width, height = _size_of(path) or (2, 1)  # is refused where its pixels are read
        panoramic = stitched and width == 2 * height
        return QueryPicture(path.stem, time, path, photo=not panoramic)

    if source.is_file():
        return [picture(source, 0.0)]
    paths = _images(source)
    if not paths:
        raise GsbaError(f"{source}: holds no JPEG, PNG, WebP or TIFF image")
    names, table = [path.stem for path in paths], source / "timestamps.csv"
    given = table if table.is_file() else None
    tagged = [(path,) for path in paths] if all(map(_size_of, paths)) else []
    times, _ = frame_times(names, given, None, True, tagged)
    order = np.argsort(times, kind="stable")
    return [picture(paths[n], float(times[n])) for n in order]


def _size_of(path: Path) -> tuple[int, int] | None:
    """Width and height of an image by its header; None = it cannot be read."""
    try:
        return image_size(path)
    except GsbaError:
        return None


def _frames_of_several_images(folder: Path, cameras: PictureCameras) -> list[QueryPicture]:
    chosen, errors = cameras.chosen, list[GsbaError]()
    found = dict[int, FrameSet]()  # by camera: raw fisheyes by each calibration that reads them
    for camera, calibration in enumerate(cameras.calibrations):
        if calibration is None or chosen not in (None, camera):
            continue
        try:
            given = {"calibration": calibration, "min_frames": 1}
            found[camera] = scan(folder, order_suffices=True, **given)
        except GsbaError as error:
            errors.append(error)
    if not found:
        if len(errors) == len(cameras.formats):  # nothing but raw fisheyes
            raise errors[0]
        frames = scan(folder, order_suffices=True, min_frames=1)
        found = {cameras.of_frames(frames.format, str(folder)): frames}
    camera = next(iter(found))
    if len(found) > 1:
        camera = cameras.of_raw({c: frames.format for c, frames in found.items()}, str(folder))
    frames = found[camera]
    times = frames.timestamps.tolist()
    return [QueryPicture(n, times[f], None, frames, f, camera) for f, n in enumerate(frames.names)]
