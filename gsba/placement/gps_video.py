"""GPS fixes that a camera records into its video, by `telemetry_parser`."""

from pathlib import Path

from gsba.config import GpsSettings
from gsba.placement.gps import GpsFixes


def is_recording(path: Path) -> bool:
    return path.suffix.lower() in (".mp4", ".360", ".insv", ".mov", ".osv", ".lrv")


def read_video_gps(path: Path, settings: GpsSettings | None = None) -> GpsFixes:
    raise NotImplementedError
