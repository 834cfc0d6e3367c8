"""Fields of protobuf messages without a schema (https://protobuf.dev/programming-guides/encoding)."""

import struct
from collections.abc import Iterator
from typing import Any


def read_message(data: object) -> tuple[dict[int, Any], bool]:
    """Fields of a protobuf message, the last of each number; and True if all could be read.

    Args:
        data: bytes; other types count as an empty message.

    Returns:
        number -> value: int of a varint, float of 8 or 4 bytes, bytes of other fields.
    """
    values: dict[int, Any] = {}
    try:
        for number, value in _fields(data if isinstance(data, bytes) else b""):
            values[number] = value
    except (IndexError, ValueError, struct.error):
        return values, False
    return values, True


def _fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield number and value of each field; damaged data raise ValueError and others."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
        elif wire == 1:
            value, at = struct.unpack_from("<d", data, at)[0], at + 8
        elif wire == 5:
            value, at = struct.unpack_from("<f", data, at)[0], at + 4
        elif wire == 2:
            count, at = _varint(data, at)
            if not 0 <= count <= len(data) - at:
                raise ValueError
            value, at = data[at : at + count], at + count
        else:
            raise ValueError
        yield number, value


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Integer of 7 bits a byte, two's complement of 64 bits, and the offset after it."""
    value = 0
    for shift in range(0, 70, 7):
        byte, at = data[at], at + 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value - (1 << 64) if value >> 63 == 1 else value & ((1 << 64) - 1), at
    raise ValueError
