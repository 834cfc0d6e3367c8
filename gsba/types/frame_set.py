"""The captured frames on disk, and the cameras that took them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

FACES = ("front", "right", "back", "left", "up", "down")
NO_FILE_NAME = re.compile(r"[/\x00-\x1f\x7f-\x9f\ud800-\udfff]|^\.{0,2}$")


@dataclass(frozen=True, slots=True)
class Fisheye:
    """Intrinsics and extrinsics of one fisheye lens (Kannala and Brandt, PAMI 2006).

    A ray at an angle theta from the axis is seen r pixels from `principal`:
    r = focal (theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9).
    """

    width: int  # pixels of its image
    height: int  # pixels
    focal: float  # pixels per radian in the middle
    principal: tuple[float, float]  # pixels, corner origin
    radial: tuple[float, float, float, float]  # k1 to k4
    rotation: tuple[float, float, float]  # rotation vector of rig_R_lens, radians
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the rig, metres; all 0 = not known


@dataclass(frozen=True, slots=True)
class PictureFormat:
    """The pictures of one camera in one mode, and the calibration that they are read by. Raises
    ValueError: a face that cannot be a file name; exported files carry it."""

    layout: str  # "erp" (2:1 equirectangular), "fisheye" (one image per lens, read as a panorama),
    # "eac" (two tracks of an equi-angular cube map, read as a panorama or as faces) or "cube" (one
    # 90-degree image per face)
    width: int  # pixels of one image (panorama or face)
    height: int  # pixels
    faces: tuple[str, ...] = ()  # faces present, in FACES order; () for panoramas
    correction: tuple[float, ...] = ()  # stitching field: coefficients of a factors.SphereField,
    # radians; panoramas and masks are read as corrected by it
    fisheyes: tuple[Fisheye, ...] | None = None  # L lenses, the front one first, with which
    # "fisheye" frames are read as panoramas
    tracks: tuple[int, int] | None = None  # width and height, pixels, of either image of "eac"
    # frames; None = of another layout
    lenses_nominal: bool = False  # True = `fisheyes` are initial values that need self-calibration:
    # ideal lenses in the image circles, a factory calibration, or one that images contradict

    def __post_init__(self) -> None:
        for face in self.faces:
            if face not in FACES:
                raise ValueError(f"{face!r:.60} is no face of a cube")

    @property
    def panoramic(self) -> bool:
        """True if a frame is read as one equirectangular image, not as several faces."""
        return self.layout != "cube"

    @property
    def lens_axes_known(self) -> bool:
        """True if the lenses' axes are along the rig's z: no stabiliser has rotated the images."""
        return self.layout in ("fisheye", "eac")

    @property
    def panorama_width(self) -> int:
        """Width in pixels of a panorama with the frames' angular resolution."""
        return self.width if self.panoramic else 4 * self.width

    @property
    def native_face_size(self) -> int:
        """Width in pixels of a 90-degree face with the frames' angular resolution."""
        return self.width // 4 if self.panoramic else self.width


def rows_across(num: int, most: int) -> np.ndarray:
    """At most `most` rows (N,) int64 of `num`, evenly from the first to the last."""
    return np.unique(np.linspace(0, num - 1, min(num, most)).astype(int))


def cameras_of(of_frame: Sequence[int], rows: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """Cameras (C',) that took frames `rows` (F',), and the one of each frame among these.

    Args:
        of_frame: (F,) index of each frame's camera; () = there is one camera, here and in the
            result.
    """
    if not of_frame:
        return np.zeros(1, np.int64), ()
    used, numbers = np.unique(np.array(of_frame)[rows], return_inverse=True)
    return used, tuple(numbers.tolist()) if len(used) > 1 else ()


def _owner(name: str) -> str:
    """Recording of a frame by its name; "" = there is only one."""
    return name.rpartition("/")[0]


@dataclass(frozen=True, slots=True)
class FrameSet:
    """The captured frames on disk, without pixels: in time order, or in that in which stills are
    most alike. Raises ValueError: a name that cannot be a file name; exported files carry them."""

    names: tuple[str, ...]  # (F,) unique, without folder or extension; RECORDING/NAME if the frames
    # are of several recordings, whose frames follow one another
    paths: tuple[tuple[Path, ...], ...]  # (F,)(1) for "erp", (F,)(L) for "fisheye": a picture of
    # each lens, the front one first, (F,)(2) for "eac": track 0 and the second one,
    # (F,)(len(faces)) for "cube"
    timestamps: np.ndarray  # (F,) float64, seconds, strictly increasing
    mask_paths: tuple[Path | None, ...]  # (F,) ERP masks, white = use; None = use all
    formats: tuple[PictureFormat, ...]  # (C,) of each camera's pictures
    camera_of_frame: tuple[int, ...] = ()  # (F,) index of the camera that took each frame; every
    # camera took some; () = there is one camera
    timed: bool = True  # True = timestamps are times; False = they only give the order
    fetched: tuple[bool, ...] = ()  # (F,) frames of a video that were added where the map of the
    # chosen ones was weak: datasets leave them out; () = none
    clock_shifts: tuple[float, ...] = ()  # (F,) seconds by which a frame's time on the clock of its
    # recording was shifted, so that recordings follow one another; () = none was
    timed_of_frame: tuple[bool, ...] = ()  # (F,) `timed` of each frame's recording, where
    # recordings differ; () = they do not

    def __post_init__(self) -> None:
        for name in self.names:
            parts = name.split("/") if self.clock_shifts else [name]
            if len(parts) > 2 or any(map(NO_FILE_NAME.search, parts)):
                raise ValueError(f"{name!r:.60} cannot be the name of a frame")

    def __len__(self) -> int:
        return len(self.names)

    def chosen(self) -> np.ndarray:
        """Frames (F',) int64 that datasets hold: all that were not added later (`fetched`)."""
        return np.flatnonzero(~np.array(self.fetched or (False,) * len(self), bool))

    def with_timed(self, timed: tuple[bool, ...]) -> "FrameSet":
        """These frames with `timed` (F,): True for times in seconds, False for mere numbers."""
        differing = timed if len({*timed}) > 1 else ()
        return replace(self, timed=all(timed), timed_of_frame=differing)

    @property
    def timed_frames(self) -> np.ndarray:
        """Frames (F,) bool whose timestamps are times."""
        return np.array(self.timed_of_frame or (self.timed,) * len(self), bool)

    @property
    def recordings(self) -> dict[str, np.ndarray]:
        """Frames (R,) int64 of each recording by its name, in order; {} if there is only one."""
        owners, numbers = dict.fromkeys(map(_owner, self.names)), self.recording_of_frame
        return {name: np.flatnonzero(numbers == n) for n, name in enumerate(owners) if name}

    @property
    def recording_of_frame(self) -> np.ndarray:
        """Index (F,) int64 of the recording of each frame, in the order of `recordings`."""
        owners = list(map(_owner, self.names))
        numbers = {name: number for number, name in enumerate(dict.fromkeys(owners))}
        return np.array([numbers[name] for name in owners], np.int64)

    @property
    def cameras(self) -> np.ndarray:
        """Index (F,) int64 of the camera that took each frame."""
        return np.array(self.camera_of_frame or (0,) * len(self), np.int64)

    @property
    def format(self) -> PictureFormat:
        """Format of the frames of a single camera. Raises ValueError: there are several cameras."""
        (only,) = self.formats
        return only

    def format_of(self, frame: int) -> PictureFormat:
        """Format of one frame's pictures."""
        return self.formats[self.camera_of_frame[frame] if self.camera_of_frame else 0]

    def with_formats(self, formats: Sequence[PictureFormat]) -> "FrameSet":
        """The frames, read by another format (C,) of each camera."""
        if len(formats) != len(self.formats):
            raise ValueError(f"{len(formats)} formats of {len(self.formats)} cameras")
        return replace(self, formats=tuple(formats))

    def taken(self, rows: np.ndarray, absolute: bool = False) -> "FrameSet":
        """Frames `rows` (F',), in this order, and their cameras; `absolute` paths serve processes
        in other folders."""
        paths = tuple(self.paths[f] for f in rows)
        mask_paths = tuple(self.mask_paths[f] for f in rows)
        if absolute:
            paths = tuple(tuple(path.absolute() for path in group) for group in paths)
            mask_paths = tuple(path and path.absolute() for path in mask_paths)
        used, of_frame = cameras_of(self.camera_of_frame, rows)
        timed = tuple(self.timed_frames[rows].tolist())
        return replace(
            self,
            names=tuple(self.names[f] for f in rows),
            paths=paths,
            timestamps=self.timestamps[rows],
            mask_paths=mask_paths,
            formats=tuple(self.formats[c] for c in used) or self.formats[:1],
            camera_of_frame=of_frame,
            fetched=tuple(self.fetched[f] for f in rows) if self.fetched else (),
            clock_shifts=tuple(self.clock_shifts[f] for f in rows) if self.clock_shifts else (),
        ).with_timed(timed)
