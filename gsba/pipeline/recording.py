"""A recording, as a caller gives it: frames, and what is known of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsba.log import GsbaError
from gsba.masks import merging


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording of a place, with a clock, a trajectory and a gyro of its own.

    Paths may be text. Fields without a comment are those of `gsba.refine`.
    """

    frames: Path | str  # folder of frames, or a video
    trajectory: Path | str | Sequence[Path | str] | None = None
    name: str = ""  # folder of its frames in exports; "" = that of its folder or video
    keyframes: Path | str | None = None
    masks: merging.Masks = merging.AUTO
    timestamps: Path | str | None = None
    fps: float | None = None
    calibration: Path | str | None = None
    circles: Sequence[tuple[float, float, float]] = ()
    imu: Path | str | None = None
    odometry: bool | None = None
    camera: str | None = None  # camera model, as the setting camera.name; None = not known


def names_of(recordings: Sequence[Recording]) -> list[str]:
    """A name for each recording: its own, else that of its folder or video.

    Folders of one name, such as `images`, get their parents' names before theirs.

    Raises:
        GsbaError: two recordings have one name.
    """
    paths = [Path(one.frames).resolve() for one in recordings]
    for path in paths:
        if paths.count(path) > 1:
            raise GsbaError(f"recording {path} is given twice: give each one once")
    stems = [path.stem if path.is_file() else path.name for path in paths]
    names = []
    for one, path, stem in zip(recordings, paths, stems, strict=True):
        repeated = stems.count(stem) > 1
        names.append(one.name or (f"{path.parent.name}-{stem}" if repeated else stem))
    for name in names:
        if names.count(name) > 1:
            places = [str(path) for path, other in zip(paths, names, strict=True) if other == name]
            raise GsbaError(
                f"recordings {places[0]} and {places[1]} are both named '{name}': give each a name "
                "(name=NAME)"
            )
    return names
