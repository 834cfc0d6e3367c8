"""Telemetry written here as a GoPro writes it: items of GPMF, in an MP4 file or alone.

Sources: GoPro, gpmf-parser (README: keys, types and nesting of GPMF); ISO/IEC 14496-12 for MP4.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def item(key: str, kind: str, size: int, data: bytes) -> bytes:
    """One item of GPMF: key, type, size of an element, number of them, and the elements."""
    head = struct.pack(">4scBH", key.encode(), kind.encode(), size, len(data) // size)
    return head + data + bytes(-len(data) % 4)


def nest(key: str, *items: bytes) -> bytes:
    """An item that holds others."""
    return item(key, "\0", 1, b"".join(items))


def box(kind: str, *parts: bytes) -> bytes:
    """A box of an MP4 file."""
    body = b"".join(parts)
    return struct.pack(">I4s", 8 + len(body), kind.encode()) + body


def words(*values: int) -> bytes:
    """Whole numbers of four bytes."""
    return struct.pack(f">{len(values)}I", *values)


def write_mp4(path: Path, packets: Sequence[bytes]) -> Path:
    """A file with a track of telemetry alone, a packet a second."""
    num, total = len(packets), 1000 * len(packets)
    start = box("ftyp", b"mp41", words(0), b"mp41")
    starts = np.cumsum([len(start) + 8, *map(len, packets[:-1])]).tolist()
    matrix = words(0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)
    table = box(
        "stbl",
        box("stsd", words(0, 1), box("gpmd", bytes(6), b"\0\1", words(0))),
        box("stts", words(0, 1, num, 1000)),
        box("stsc", words(0, 1, 1, 1, 1)),
        box("stsz", words(0, 0, num, *map(len, packets))),
        box("stco", words(0, num, *starts)),
    )
    place = box("dinf", box("dref", words(0, 1), box("url ", words(1))))
    media = box(
        "mdia",
        box("mdhd", words(0, 0, 0, 1000, total, 0)),
        box("hdlr", words(0), b"mhlrmeta", bytes(12), b"\x0bGoPro MET  \0"),
        box("minf", box("gmhd", box("gmin", bytes(16))), place, table),
    )
    head = box("tkhd", words(15, 0, 0, 1, 0, total), bytes(16), matrix, bytes(8))
    film = box("mvhd", words(0, 0, 0, 1000, total, 0x10000), b"\1\0", bytes(10), matrix, bytes(28))
    path.write_bytes(start + box("mdat", *packets) + box("moov", film, box("trak", head, media)))
    return path
