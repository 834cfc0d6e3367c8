"""Check of the number of points that a scan's header claims against the size of the file.

Parsers allocate memory for all claimed points, or crash beyond the end of the file, before they
read any.
"""

import struct
from pathlib import Path

from gsba.log import GsbaError

_LAS_HEADER_BYTES = 227  # of LAS 1.0 to 1.2; 375 of 1.4
_VLR_BYTES, _EVLR_BYTES = 54, 60  # of the header of a variable-length record
_MIN_LAZ_POINT_BYTES = 0.2  # of a compressed point: equal ones in a row take 0.3
_MAX_PCD_RATIO = 255  # of uncompressed to compressed bytes in PCD
_MAX_PCD_HEADER_BYTES = 1 << 16


def check_claims(path: Path) -> None:
    """Refuse LAS, LAZ and PCD files that claim more points than their size allows.

    Raises:
        GsbaError: the file claims too many points, or its header is damaged.
    """
    suffix, size = path.suffix.lower(), path.stat().st_size
    with path.open("rb") as file:
        head = file.read(_MAX_PCD_HEADER_BYTES)
    try:
        if suffix in (".las", ".laz"):
            _check_laser(head, size)
        elif suffix == ".pcd":
            _check_pcd(head, size)
    except _TooMuch as claim:
        raise GsbaError(
            f"{path} claims {claim}, more than its {size} bytes can hold: it is truncated or "
            "damaged; copy or export it again"
        ) from None
    except (struct.error, ValueError, IndexError, KeyError):
        raise GsbaError(
            f"{path}: cannot be read (its header is damaged): copy or export it again"
        ) from None


class _TooMuch(Exception):
    """A header claims more than the file can hold; the message is the claim."""


def _check_laser(head: bytes, size: int) -> None:
    """Check the header of LAS or LAZ (LAS 1.4, section 2.4; LAZ sets high bits of the format)."""
    if head[:4] != b"LASF":
        raise ValueError
    head_size, first, num_records, kind, length, num = struct.unpack_from("<HIIBHI", head, 94)
    num_late = late = 0
    if head[25] >= 4:
        late, num_late, more = struct.unpack_from("<QIQ", head, 235)
        num = max(num, more)
    if head_size < _LAS_HEADER_BYTES or not length:
        raise ValueError
    if head_size + _VLR_BYTES * num_records > size or late + _EVLR_BYTES * num_late > size:
        raise _TooMuch(f"{num_records} and {num_late} variable-length records")
    each = _MIN_LAZ_POINT_BYTES if kind & 0xC0 else length
    if num and first + each * num > size:
        raise _TooMuch(f"{num} points")


def _check_pcd(head: bytes, size: int) -> None:
    """Check the header of a PCD file: lines of a word and numbers, of which DATA is the last."""
    fields: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in fields:
        end = head.index(b"\n", at)
        word, *numbers = head[at:end].decode("ascii", "replace").split() or ["#"]
        fields[word] = numbers
        at = end + 1
    names, kinds = fields["FIELDS"], fields["TYPE"]
    sizes = [int(text) for text in fields["SIZE"]]
    counts = [int(text) for text in fields.get("COUNT", ["1"] * len(names))]
    width, height = (int(fields.get(word, ["1"])[0]) for word in ("WIDTH", "HEIGHT"))
    num = int(fields["POINTS"][0]) if "POINTS" in fields else width * height
    if not len(names) == len(sizes) == len(counts) == len(kinds):
        raise ValueError
    if min([*sizes, *counts, num, width, height], default=0) < 0 or set(sizes) - {1, 2, 4, 8}:
        raise ValueError
    length = sum(a * b for a, b in zip(sizes, counts, strict=True))
    form, left = fields["DATA"][0], size - at
    if form == "ascii":
        least = 2 * sum(counts) * num  # a digit and a separator
        room = left + 1
    elif form == "binary":
        least, room = length * num, left
    else:
        packed, unpacked = struct.unpack_from("<II", head, at)
        least, room = max(length * num, unpacked), _MAX_PCD_RATIO * min(packed, left - 8)
        if packed > left - 8:
            raise _TooMuch(f"{packed} bytes of points")
    if least > room or width * height < num:
        raise _TooMuch(f"{num} points")
