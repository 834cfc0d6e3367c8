"""Telemetry of GoPro's and other makers' recordings, read by `telemetry_parser` (extra `imu`)."""

from pathlib import Path
from typing import Any, Literal

from gsba.log import GsbaError

_PANIC = "PanicException"  # of libraries in Rust: not an Exception, and cannot be imported


def ask_telemetry_parser(
    path: Path, method: Literal["normalized_imu", "telemetry"], what: str, instead: str
) -> list[Any]:
    """Result of a method of the library's parser for a recording.

    Args:
        what: name of the data for messages, e.g. "gyro".
        instead: alternative input for messages.

    Raises:
        GsbaError: the library is not installed, or finds no such data.
    """
    try:
        from telemetry_parser import Parser  # type: ignore[import-not-found]
    except ImportError:
        raise GsbaError(
            f"{path}: reading its {what} needs telemetry-parser: pip install 'gsba[imu]', or give "
            f"{instead}"
        ) from None
    try:
        return getattr(Parser(str(path)), method)()
    except BaseException as error:
        if not isinstance(error, OSError | ValueError) and type(error).__name__ != _PANIC:
            raise
        raise GsbaError(f"{path}: telemetry-parser finds no {what} in it ({error})") from None
