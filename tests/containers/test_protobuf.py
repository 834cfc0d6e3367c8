"""Protobuf messages: read back, cut anywhere, and lengths that lead backwards."""

import insta360_files as made
import pytest

from gsba.containers.protobuf import read_message

VALUES = {1: 5, 2: "words", 3: -7, 200: 0.25, 4: (1 << 63) - 1, 5: -(1 << 63), 6: b"", 7: 300}
READ = VALUES | {2: b"words"}


def test_fields_are_read_back() -> None:
    assert read_message(made.message(VALUES)) == (READ, True)
    assert read_message(made.varint(8 << 3 | 5) + b"\0\0\0?") == ({8: 0.5}, True)
    assert read_message(None) == ({}, True)


def test_a_message_cut_anywhere_gives_what_is_before() -> None:
    whole = made.message(VALUES)
    for at in range(len(whole)):
        values, complete = read_message(whole[:at])
        assert values.items() <= READ.items() and complete == (
            whole[:at] == made.message(dict(list(VALUES.items())[: len(values)]))
        )


@pytest.mark.parametrize("length", [-1, -9, 1 << 40, (1 << 64) - 1])
def test_a_length_that_leads_out_ends_it(length: int) -> None:
    data = made.message({1: 5}) + made.varint(2 << 3 | 2) + made.varint(length) + b"abc"
    assert read_message(data) == ({1: 5}, False)


@pytest.mark.parametrize("data", [b"\x0b", b"\x0f", b"\xff" * 11, b"\x08" + b"\x80" * 10])
def test_what_is_no_message_is_said(data: bytes) -> None:
    assert read_message(data) == ({}, False)
