"""Files dropped onto the page: resumed, renamed, refused, and never half-written."""

import json
import os
import shutil
from collections import namedtuple
from pathlib import Path
from typing import Any

import pytest
from refusals import refused

pytest.importorskip("starlette")
pytest.importorskip("httpx")

from starlette.testclient import TestClient

from gsba.app import App, drops
from gsba.app.routes import application
from gsba.log import GsbaError

FILM = {"name": "clip.mp4", "size": 10, "modified": 1_700_000_000_123}
BINARY = {"content-type": "application/octet-stream"}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    (folder / "run").mkdir(parents=True)
    (folder / "run/gsba.json").write_text("{}")
    (folder / "out").symlink_to(tmp_path)
    return folder


@pytest.fixture
def client(root: Path, tmp_path: Path) -> TestClient:
    app = App(root, tmp_path / "state", [], None, lambda _: None)  # type: ignore[arg-type]
    return TestClient(application(app), base_url=f"http://127.0.0.1:8360/{app.token}/")


def planned(root: Path, *files: dict[str, Any], folder: str = "") -> list[dict[str, Any]]:
    return drops.plan(root, folder, files)


def sent(root: Path, one: dict[str, Any], content: bytes) -> dict[str, Any]:
    """Send the rest of a file, as the page does."""
    (plan,) = planned(root, one)
    arrival = drops.Arrival(root, plan["path"], plan["size"], plan["modified"], plan["offset"])
    try:
        arrival.write(content[plan["offset"] :])
        return arrival.finish()
    finally:
        arrival.close()


def names(root: Path) -> list[str]:
    return sorted(path.name for path in root.iterdir() if path.is_file())


def test_a_file_arrives_in_parts_and_has_its_name_when_it_is_whole(root: Path) -> None:
    assert planned(root, FILM)[0]["state"] == "new"
    assert sent(root, FILM, b"0123") == {"offset": 4, "done": False}
    assert names(root) == [".clip.mp4.10-1700000000123.gsba-drop"]
    assert drops.unfinished(root) == [
        {"name": "clip.mp4", "size": 10, "offset": 4, "part": names(root)[0]}
    ]
    (plan,) = planned(root, FILM)  # the same file, dropped again
    assert (plan["state"], plan["offset"], plan["renamed"]) == ("unfinished", 4, False)
    assert sent(root, FILM, b"0123456789") == {"offset": 10, "done": True}
    assert names(root) == ["clip.mp4"] and drops.unfinished(root) == []
    assert (root / "clip.mp4").read_bytes() == b"0123456789"
    assert (root / "clip.mp4").stat().st_mtime_ns == FILM["modified"] * 10**6
    assert planned(root, FILM)[0]["state"] == "here"


def test_a_name_that_is_taken_is_not_overwritten(root: Path) -> None:
    (root / "clip.mp4").write_bytes(b"other")
    (plan,) = planned(root, FILM)
    assert (plan["path"], plan["renamed"]) == ("clip-2.mp4", True)
    sent(root, FILM, b"01")
    other = FILM | {"size": 11}
    both = planned(root, FILM, other, other | {"size": 12})  # two of one name in one drop, too
    assert [one["path"] for one in both] == ["clip-2.mp4", "clip-3.mp4", "clip-4.mp4"]
    assert (root / "clip.mp4").read_bytes() == b"other"


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("../../etc/x.mp4", "etc/x.mp4"),
        ("a\0b\n/c:d.mp4", "a_b_/c_d.mp4"),
        ("-rf.mp4", "rf.mp4"),
        ("..mp4.mp4", "mp4.mp4"),
        ("walk/frame 01.JPG", "walk/frame 01.JPG"),
        ("ä" * 200 + ".mp4", "ä" * 88 + ".mp4"),
    ],
)
def test_names_are_made_safe(root: Path, name: str, path: str) -> None:
    assert planned(root, FILM | {"name": name})[0]["path"] == path


@pytest.mark.parametrize(
    ("one", "message"),
    [
        ({"name": "notes.docx"}, "notes.docx is no footage: drop videos"),
        ({"name": "page.html"}, "no footage"),
        ({"name": "gsba.json"}, "no footage"),  # it would make the folder a run
        ({"name": "..."}, "no name that can be used"),
        ({"name": "a/b/c/d/e.mp4"}, "no name that can be used"),
        ({"name": "\ud800.mp4"}, "half characters"),
        ({"name": "out/x.mp4"}, "outside"),
        ({"name": "run/x.mp4"}, "run is a run"),
        ({"size": 0}, "clip.mp4 is empty"),
        ({"size": "x"}, "has a name, a size and a time"),
        ({"size": 10**18}, "the disk is full: clip.mp4 needs 1000000000.0 GB more"),
    ],
)
def test_what_cannot_be_taken_is_said_in_one_line(
    root: Path, one: dict[str, Any], message: str
) -> None:
    (plan,) = planned(root, FILM | one)
    assert message in plan["error"] and "\n" not in plan["error"]
    assert names(root) == []
    with pytest.raises(GsbaError):
        drops.Arrival(root, str((FILM | one)["name"]) + "x", 10, 0, 0)


def test_a_full_disk_keeps_what_has_arrived(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent(root, FILM, b"0123")

    def full(*_: Any) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    refused(r"the disk is full: clip.mp4 .*40 % of it is kept", sent, root, FILM, b"0123456789")
    monkeypatch.undo()
    usage = namedtuple("usage", "free")(100 * 2**20 + 5)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    error = planned(root, FILM)[0]["error"]  # 1 byte is missing
    assert "disk is full" in error and "free 1 MB" in error
    assert planned(root, FILM | {"size": 5, "name": "a.mp4"})[0]["error"] == ""
    monkeypatch.undo()
    assert sent(root, FILM, b"0123456789")["done"]


def test_parts_that_do_not_fit_are_refused(root: Path) -> None:
    path, size, modified = "clip.mp4", 10, FILM["modified"]
    first = drops.Arrival(root, path, size, modified, 0)
    refused("sent by another page", drops.Arrival, root, path, size, modified, 0)
    refused("sent by another page", drops.discard, root, "", names(root)[0])
    refused("longer than announced", first.write, b"01234567890")
    first.write(b"0123")
    first.close()
    refused("arrived up to byte 4", drops.Arrival, root, path, size, modified, 3)
    for part in ("clip.mp4", "../root/" + names(root)[0], "gsba.json"):
        refused("no unfinished drop", drops.discard, root, "", part)
    drops.discard(root, "", names(root)[0])
    assert names(root) == []
    for path in ("../x.mp4", "out/x.mp4", "/x.mp4", "run/x.mp4", ".x.mp4", "x.html"):
        with pytest.raises(GsbaError):
            drops.Arrival(root, path, size, modified, 0)


def test_only_the_page_sends_files(client: TestClient, root: Path) -> None:
    query = {"path": "clip.mp4", "size": 10, "modified": 5, "offset": 0}
    send = client.post("upload", params=query, content=b"0123", headers=BINARY)
    assert send.json() == {"offset": 4, "done": False}
    for headers in (
        {"content-type": "text/plain"},
        {"content-type": "multipart/form-data"},
        {"content-type": "application/json"},
        BINARY | {"origin": "http://evil.example"},
        BINARY | {"host": "evil.example"},
    ):
        answer = client.post("upload", params=query | {"offset": 4}, content=b"4", headers=headers)
        assert answer.status_code == 403
    assert client.post("api/add", content=b"{}", headers=BINARY).status_code == 403
    bare = client.post("http://127.0.0.1:8360/upload", params=query, content=b"", headers=BINARY)
    assert bare.status_code == 403
    for change in ({"offset": "x"}, {"path": "../x.mp4"}, {"size": ""}):
        answer = client.post("upload", params=query | change, content=b"4", headers=BINARY)
        assert answer.status_code == 400 and answer.json()["error"]
    rest = client.post("upload", params=query | {"offset": 4}, content=b"456789", headers=BINARY)
    assert rest.json()["done"] and (root / "clip.mp4").read_bytes() == b"0123456789"
    found = client.get("api/browse").json()
    assert [one["name"] for one in found["entries"]] == ["run", "clip.mp4"]
    assert found["unfinished"] == []
    plans = client.post("api/drop", json={"folder": "", "files": [FILM, 5]}).json()["files"]
    assert plans[0]["path"] == "clip-2.mp4" and "has a name" in plans[1]["error"]
    assert client.post("api/drop", json={"folder": "run", "files": []}).status_code == 400
    assert client.post("api/discard", json={"part": "clip.mp4"}).status_code == 400
    assert json.loads((root / "run/gsba.json").read_text()) == {}
