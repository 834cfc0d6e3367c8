"""The camera of a new picture, of those that a run has: told by its layout and size."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from gsba.frames.recordings import names_of_cameras
from gsba.log import GsbaError
from gsba.store.store import load_stage
from gsba.types import FrameSet, PictureFormat

_CALIBRATION = "calibration.json"  # of the raw fisheyes of a run of one camera, in its folder


@dataclass(frozen=True, slots=True)
class PictureCameras:
    """Cameras of a map that may have taken new pictures."""

    formats: tuple[PictureFormat, ...]  # (C,)
    names: tuple[str, ...]  # (C,) a recording of each; "" of the only camera of a run
    calibrations: tuple[Path | None, ...]  # (C,) file of the lenses of each; None = they are no raw
    # fisheyes
    chosen: int | None = None  # that took all pictures; None = their layout and size tell

    @classmethod
    def of(cls, root: Path, frames: FrameSet, recording: str | None = None) -> "PictureCameras":
        """Cameras of a map.

        Args:
            recording: whose camera took all pictures; None = their layout and size tell.

        Raises:
            GsbaError: the map has no such recording.
        """
        whole = load_stage(root, "frames", FrameSet)
        several, first = len(whole.formats) > 1, names_of_cameras(whole)
        names, files = list[str](), list[Path | None]()
        for own in names_of_cameras(frames) if len(frames.formats) > 1 else [""]:
            name = own or next(iter(frames.recordings), "")
            number = int(whole.cameras[whole.recordings[name][0]]) if several else 0
            file = root / (f"calibration@{first[number]}.json" if several else _CALIBRATION)
            names.append(name if several else "")
            files.append(file if file.is_file() else None)
        chosen = None
        if recording is not None:
            rows = frames.recordings.get(recording)
            if rows is None:
                known = ", ".join(frames.recordings) or "one recording alone"
                raise GsbaError(
                    f"{root} has no recording '{recording}' in this map: it has {known}"
                )
            chosen = int(frames.cameras[rows[0]])
        return cls(frames.formats, tuple(names), tuple(files), chosen)

    def layouts(self) -> set[str]:
        """Layouts that pictures may have, see `PictureFormat`."""
        return {self.formats[c].layout for c in self.those(lambda kind: True)}

    def of_panorama(self, width: int, height: int, name: str) -> int:
        """Camera of a stitched panorama: that of its size, pixels, or the only one of stitched
        panoramas; GsbaError if it can be of several."""
        stitched = self.those(lambda kind: kind.layout == "erp") or range(len(self.formats))
        alike = [c for c in stitched if self.formats[c].width == width]
        return self._only(alike or list(stitched), f"{name}: is {width}x{height}")

    def of_raw(self, read: Mapping[int, PictureFormat], name: str) -> int:
        """Camera of raw fisheyes, of those whose calibrations can read them (with the formats
        read): that of their size; GsbaError if they can be of several."""
        alike = [c for c, kind in read.items() if raw_sizes(kind) == raw_sizes(self.formats[c])]
        return self._only(alike or list(read), f"{name}: holds raw fisheyes")

    def of_frames(self, kind: PictureFormat, name: str) -> int:
        """Camera of frames of several images each: that of their layout and size; GsbaError if they
        can be of several, or of none."""
        if len(self.formats) == 1:
            return 0
        size = kind.width, kind.height, kind.tracks, raw_sizes(kind)
        alike = self.those(
            lambda one: (
                one.layout == kind.layout
                and (one.width, one.height, one.tracks, raw_sizes(one)) == size
            )
        )
        told = f"{name}: holds frames of layout {kind.layout} and {kind.width}x{kind.height}"
        return self._only(alike, told)

    def those(self, fits: Callable[[PictureFormat], bool]) -> list[int]:
        """Cameras that pictures may be of, whose format fits."""
        each = enumerate(self.formats)
        return [c for c, kind in each if self.chosen in (None, c) and fits(kind)]

    def _only(self, alike: list[int], told: str) -> int:
        if self.chosen is not None:
            return self.chosen
        if len(alike) == 1:
            return alike[0]
        known = ", ".join(
            f"{kind.layout} {kind.width}x{kind.height} ({name})"
            for kind, name in zip(self.formats, self.names, strict=True)
        )
        if not alike:
            raise GsbaError(f"{told}; the run's cameras have {known}: give pictures of one of them")
        raise GsbaError(
            f"{told}; the run's cameras have {known}: name a recording of the one that took it "
            "(--camera-of RECORDING)"
        )


def raw_sizes(kind: PictureFormat) -> tuple[tuple[int, int], ...]:
    """Width and height of the picture of each raw lens."""
    return tuple((lens.width, lens.height) for lens in kind.fisheyes or ())
