"""Recordings whose telemetry `telemetry_parser` reads (extra `imu`): those of GoPro and others."""

from pathlib import Path
from typing import Any, Literal

from gsba.log import GsbaError

_EXTRA = "gsba[imu]"
_PANIC = "PanicException"  # of libraries in Rust: no Exception, and nowhere to import it from


def ask_telemetry_parser(
    path: Path, method: Literal["normalized_imu", "telemetry"], what: str, instead: str
) -> list[Any]:
    """What a method of the library's parser gives of a recording.

    Args:
        path: of the recording.
        method: of `telemetry_parser.Parser`.
        what: is asked for, for messages: "gyro".
        instead: what a user can give in its place, for messages.

    Raises:
        GsbaError: the library is not installed, or finds nothing.
    """
    try:
        from telemetry_parser import Parser  # type: ignore[import-not-found]
    except ImportError:
        raise GsbaError(
            f"{path}: its {what} is read by telemetry-parser: pip install '{_EXTRA}', or give "
            f"{instead}"
        ) from None
    try:
        return getattr(Parser(str(path)), method)()
    except BaseException as error:
        if not isinstance(error, OSError | ValueError) and type(error).__name__ != _PANIC:
            raise
        raise GsbaError(f"{path}: telemetry-parser finds no {what} in it ({error})") from None
