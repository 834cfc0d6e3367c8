"""Scans from strangers: more claimed than is there, libraries that crash, points of one place."""

import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from gsba.scans import read_scan, trial
from gsba.scans.files import check_claims
from gsba.scans.fit import noise_of
from gsba.scans.trial import try_in_process
from gsba.scans.types import Cloud, Scan
from gsba.similarity import Sim3


def _las(num: int = 10, records: int = 0, kind: int = 0, more: int = 0, late: int = 0) -> bytes:
    """The header of a LAS 1.4 file, and what ten points of 20 bytes take."""
    head = bytearray(375)
    head[:4], head[24:26] = b"LASF", bytes((1, 4))
    struct.pack_into("<HIIBHI", head, 94, 375, 375, records, kind, 20, num)
    struct.pack_into("<QIQ", head, 235, 0, late, more)
    return bytes(head) + bytes(200)


def _pcd(num: int = 10, data: str = "binary", left: bytes = bytes(120), **other: str) -> bytes:
    fields = {"FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"}
    fields |= {"WIDTH": str(num), "HEIGHT": "1", "POINTS": str(num), **other, "DATA": data}
    lines = "".join(f"{word} {value}\n" for word, value in fields.items() if value)
    return f"# .PCD v0.7\n{lines}".encode() + left


def _packed(packed: int, unpacked: int) -> bytes:
    return struct.pack("<II", packed, unpacked) + bytes(112)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.las", _las()),
        ("a.laz", _las(num=10, kind=0x80)),
        ("a.las", _las(num=0)),
        ("a.pcd", _pcd()),
        ("a.pcd", _pcd(COUNT="", POINTS="")),
        ("a.pcd", _pcd(10, "ascii", b"0 0 0\n" * 10)),
        ("a.pcd", _pcd(10, "binary_compressed", _packed(100, 120))),
        ("a.ply", b"ply\n"),
    ],
)
def test_counts_that_a_file_can_hold_pass(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    check_claims(tmp_path / name)


@pytest.mark.parametrize(
    ("name", "content", "claim"),
    [
        ("a.las", _las(num=11), "claims 11 points"),
        ("a.las", _las(more=2**60), f"claims {2**60} points"),
        ("a.las", _las(records=10**8), "claims 100000000 and 0 variable-length records"),
        ("a.las", _las(late=10**8), "claims 0 and 100000000 variable-length records"),
        ("a.laz", _las(num=10**9, kind=0x80), "claims 1000000000 points"),
        ("a.pcd", _pcd(11), "claims 11 points"),
        ("a.pcd", _pcd(10**12), f"claims {10**12} points"),
        ("a.pcd", _pcd(COUNT="1 1 1000"), "claims 10 points"),
        ("a.pcd", _pcd(WIDTH="3"), "claims 10 points"),
        ("a.pcd", _pcd(10, "ascii", b"0 0 0\n" * 9), "claims 10 points"),
        ("a.pcd", _pcd(10, "binary_compressed", _packed(500, 120)), "claims 500 bytes of points"),
        ("a.pcd", _pcd(10, "binary_compressed", _packed(100, 2**32 - 1)), "claims 10 points"),
        ("a.las", b"LASF", "header is damaged"),
        ("a.las", b"", "header is damaged"),
        ("a.pcd", b"", "header is damaged"),
        ("a.pcd", b"\xff" * 100_000, "header is damaged"),
        ("a.pcd", _pcd(SIZE="4 4"), "header is damaged"),
        ("a.pcd", _pcd(SIZE="4 4 -4"), "header is damaged"),
        ("a.pcd", _pcd(WIDTH="-10"), "header is damaged"),
        ("a.pcd", _pcd(WIDTH="many"), "header is damaged"),
    ],
)
def test_counts_beyond_a_file_are_refused(
    tmp_path: Path, name: str, content: bytes, claim: str
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(claim, check_claims, tmp_path / name)


_HEAD = "import sys, json; sys.path[:] = json.loads(sys.argv[1])\nfrom pathlib import Path\n"
_TRIAL = _HEAD + "from gsba.scans import trial; path = Path(sys.argv[2])\n"


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", r"crashed .*\(SIGSEGV\)"),
        ("raise SystemExit(7)", r"crashed .*\(exit 7\)"),
        ("trial.limited(path, lambda _: bytearray(1 << 36))", r"cannot be read \(out of memory\)"),
        (
            "trial._BASE_CPU_S = 0\ndef spin(_):\n  while 1: pass\ntrial.limited(path, spin)",
            "too long",
        ),
        ("sys.stderr.write('RPly: torn')", r"to its end \(RPly: torn\)"),
        ("def no(_): raise trial.GsbaError('not this')\ntrial.limited(path, no)", "^not this$"),
        ("def no(_): raise SystemExit('Rust panics')\ntrial.limited(path, no)", "Rust panics"),
    ],
)
def test_crashes_of_libraries_are_refusals(
    tmp_path: Path, code: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.pcd"
    path.write_bytes(b"")
    monkeypatch.setattr(trial, "_CHILD", (_TRIAL if "trial." in code else _HEAD) + code)
    refused(message, try_in_process, path)


def test_what_is_read_on_trial_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And finds modules where this process does, not where it works."""
    (tmp_path / "json.py").write_text("raise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trial, "_CHILD", _TRIAL + "trial.limited(path, Path.read_bytes)")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "a.pcd").write_bytes(b"x" * 1000)
    try_in_process(tmp_path / "a.pcd")


def test_noise_of_a_wrong_scan_stays_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The search for it wanders: 1e200 squared is no Python float."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (500, 3)) * [1, 1, 0.001]
    cloud = Cloud(points, np.zeros((500, 3, 3)), points, np.arange(500), points, points[:, 0])
    scan = Scan(points, np.tile([0.0, 0, 1], (500, 1)))
    tried = []

    def wanders(cost, start, **_):
        for step in (0.0, 1000.0, -1000.0, [0, 400, 0], [0, -1e5, 0]):
            tried.append(cost(start + np.array(step)))
        return type("Result", (), {"x": start + 1000.0})

    monkeypatch.setattr("scipy.optimize.minimize", wanders)
    found = noise_of(Sim3(), cloud, scan, 0.01)
    assert len(tried) == 5 and np.isfinite([found.sigma, found.factor, found.inliers]).all()


@pytest.mark.parametrize("kind", ["obj", "pcd", "ply", "far"])
def test_points_of_one_place_are_refused(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("open3d", reason="open3d is not installed: pip install 'gsba[scan]'")
    path = tmp_path / f"a.{kind.replace('far', 'obj')}"
    if kind == "pcd":
        path.write_bytes(_pcd(5000, left=bytes(60_000)))
    elif kind == "ply":
        head = "ply\nformat ascii 1.0\nelement vertex 5000\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_text(head + "1 2 3\n" * 5000)
    else:
        corner = "1e30" if kind == "far" else "1"
        path.write_text(f"v {corner} 2 3\n" * 30 + "f 1 2 3\nf 4 5 6\n")
    refused(r"triangles is 0|distinct points|beyond 1e\+09 units", read_scan, path)
