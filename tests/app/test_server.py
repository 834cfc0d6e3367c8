"""The page's requests: who gets answers, what may be chosen, and what is run."""

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tiny_run import LIGHT, Case
from waiting import until

pytest.importorskip("starlette")
pytest.importorskip("httpx")

from starlette.testclient import TestClient

from gsba.app import App, Form, serve
from gsba.app.routes import PAGE, application
from gsba.cli.serving import COMMANDS, check, choices, form_of
from gsba.log import GsbaError
from gsba.trajectory.files import read_trajectory


@pytest.fixture
def root(tmp_path: Path) -> Path:
    folder = tmp_path / "root"
    (folder / "walk").mkdir(parents=True)
    (folder / "walk/a.jpg").write_bytes(b"")
    (folder / "clip.mp4").write_bytes(b"no video")
    (folder / "<img src=x onerror=alert(1)>.txt").write_text("")
    (tmp_path / "secret.txt").write_text("secret")
    (folder / "out").symlink_to(tmp_path)
    return folder


@pytest.fixture
def app(root: Path, tmp_path: Path) -> Iterator[App]:
    made = App(root, tmp_path / "state", [form_of(name) for name in COMMANDS], choices(), check)
    yield made
    made.close()


@pytest.fixture
def client(app: App) -> TestClient:
    return TestClient(application(app), base_url=f"http://127.0.0.1:8360/{app.token}/")


def post(client: TestClient, path: str, body: dict[str, Any]) -> Any:
    return client.post(path, json=body).json()


def test_without_the_token_nothing_is_answered(app: App, client: TestClient) -> None:
    bare = TestClient(application(app), base_url="http://127.0.0.1:8360")
    for path in ("/", "/api/jobs", "/api/browse", f"/{app.token}x/", "/app.js"):
        assert bare.get(path).status_code == 403
    assert bare.post("/api/add", json={}).status_code == 403
    assert client.get("api/jobs").status_code == 200
    assert app.token == App(app.root, app.jobs.root, [], app.choices, check).token
    assert (app.jobs.root / "token").stat().st_mode & 0o077 == 0


def test_the_address_can_be_opened_as_soon_as_it_is_printed(app: App) -> None:
    pytest.importorskip("uvicorn")

    class Reached(Exception):
        pass

    def started(address: str) -> None:
        port = int(address.split(":")[2].split("/")[0])
        socket.create_connection(("127.0.0.1", port), timeout=10).close()
        raise Reached

    with pytest.raises(Reached):
        serve(app, 0, started)


@pytest.mark.parametrize(
    "headers",
    [
        {"host": "evil.example"},
        {"host": "192.168.0.5:8360"},
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
    ],
)
def test_other_pages_get_no_answers(client: TestClient, headers: dict[str, str]) -> None:
    assert client.get("api/jobs", headers=headers).status_code == 403
    assert client.post("api/add", json={}, headers=headers).status_code == 403


def test_a_form_of_another_page_changes_nothing(client: TestClient) -> None:
    for kind in ("text/plain", "application/x-www-form-urlencoded"):
        answer = client.post("api/add", content=b"{}", headers={"content-type": kind})
        assert answer.status_code == 403
    assert client.get("api/jobs").json() == {"jobs": []}


def test_the_page_loads_nothing_from_elsewhere(client: TestClient) -> None:
    for name in ("", *PAGE):
        answer = client.get(name)
        assert answer.status_code == 200
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "http://" not in answer.text.replace("http://www.w3.org/2000/svg", "")
        assert "https://" not in answer.text and "innerHTML" not in answer.text
    assert client.get("nothing.js").status_code == 404


def test_the_chooser_stays_below_its_root(client: TestClient, tmp_path: Path) -> None:
    found = client.get("api/browse", params={"path": ""}).json()
    kinds = {entry["name"]: entry["kind"] for entry in found["entries"]}
    assert kinds["walk"] == "folder" and kinds["clip.mp4"] == "video" and "out" not in kinds
    for path in ("..", "walk/../..", "/etc", "out", str(tmp_path / "secret.txt"), "a\0b"):
        assert client.post("api/about", json={"paths": [path]}).status_code == 400
        for request in ("browse", "info", "run", "run/map", "picture"):
            answer = client.get(f"api/{request}", params={"path": path})
            assert answer.status_code == 400 and "error" in answer.json()
    assert client.get("files/out/secret.txt").status_code == 400
    assert client.get("files/%2e%2e/secret.txt").status_code in (400, 404)
    for values in ({"frames": "../x", "out": "r"}, {"frames": "walk", "out": "../r"}):
        answer = post(client, "api/add", {"command": "refine", "values": values})
        assert "outside" in answer["error"]


def test_values_are_confined_as_they_are_used(client: TestClient) -> None:
    """Without blanks around them, and in texts, too."""
    for values in (
        {"out": " ../x "},
        {"gps": "/etc/passwd"},
        {"gps": " out/secret.txt"},
        {"recording": ["walk,name=a", "/elsewhere,name=x"]},
        {"recording": ["walk,trajectory=../x.tum"]},
        {"overrides": ["gps.file=/etc/passwd"]},
        {"factors": "bearing,gps:/etc/x"},
    ):
        given = {"frames": "walk", "out": "r"} | values
        answer = post(client, "api/add", {"command": "refine", "values": given})
        assert "outside" in answer["error"], values
    near = {"frames": "walk", "out": " r ", "gps": "walk/gps.csv", "cluster": "tcp://10.0.0.1:8786"}
    answer = post(client, "api/command", {"command": "refine", "values": near})
    assert "outside" not in answer["error"] and "--out r " in answer["command"]
    assert client.get("files/%252e%252e/secret.txt").status_code in (400, 404)
    half = {"command": "refine", "values": {"frames": "\ud800", "out": "r"}}
    for request in ("api/add", "api/command"):
        content = json.dumps(half).encode()
        kind = {"content-type": "application/json"}
        answer = client.post(request, content=content, headers=kind)
        assert answer.status_code < 500 and "half characters" in answer.json()["error"]


def test_info_of_a_file_that_is_no_video_is_one_line(client: TestClient) -> None:
    answer = client.get("api/info", params={"path": "clip.mp4"}).json()
    assert "clip.mp4" in (answer.get("problem") or answer.get("error"))


def test_the_command_is_what_the_form_says(client: TestClient) -> None:
    values = {"frames": "my walk", "out": "r", "masks": ["auto", "distractors"], "fps": "2"}
    values |= {"config": "fast", "no_trajectory": True, "circle": ["-1,2,3"], "camera": ""}
    answer = post(client, "api/command", {"command": "refine", "values": values})
    assert answer["error"] == ""
    options = "--config fast --masks auto --masks distractors --circle=-1,2,3 --fps 2"
    assert answer["command"] == f"gsba refine 'my walk' --out r --no-trajectory {options}"
    refused = post(client, "api/command", {"command": "refine", "values": values | {"fps": "x"}})
    assert "--fps" in refused["error"]
    dashed = post(client, "api/command", {"command": "refine", "values": {"frames": "-x"}})
    assert dashed["command"] == "gsba refine ./-x"


@pytest.mark.parametrize(
    "body",
    [
        {"command": "doctor", "values": {}},
        {"command": "refine", "values": {"frames": "walk", "segment": "touch x"}},
        {"command": "refine", "values": {"frames": "walk", "out": ["a", "b"]}},
        {"command": "refine", "values": {"frames": {"a": 1}, "out": "r"}},
        {"command": "refine", "values": {"frames": "walk", "out": "r", "fresh": "yes"}},
        {"command": "refine", "values": {"frames": "walk\nx", "out": "r"}},
        {"command": "refine", "values": {"out": "r"}},
        {"command": "refine", "values": {"frames": "walk"}},
        {"command": "refine", "values": []},
        {"values": {}},
    ],
)
def test_bad_forms_are_refused_in_one_line(client: TestClient, body: dict[str, Any]) -> None:
    answer = client.post("api/add", json=body)
    assert answer.status_code == 400 and answer.json()["error"].count("\n") == 0
    assert client.get("api/jobs").json() == {"jobs": []}


def test_bad_requests_are_refused(client: TestClient) -> None:
    kind = {"content-type": "application/json"}
    for content in (b"{", b"[]", b"[" * 100_000):
        assert client.post("api/add", content=content, headers=kind).status_code == 400
    assert client.post("api/add", content=b" " * 300_000, headers=kind).status_code == 413
    assert client.post("api/jobs/nothing/stop", json={}).status_code == 400
    assert client.get("api/jobs/nothing").status_code == 400


def test_forms_come_from_the_commands() -> None:
    refine = form_of("refine")
    names = {field.name for field in refine.fields}
    assert {"frames", "trajectory", "camera", "masks", "out", "config", "overrides"} <= names
    assert "segment" not in names and all(field.help for field in refine.fields)
    kinds = {field.name: field.kind for field in refine.fields}
    assert (kinds["fresh"], kinds["fps"], kinds["masks"]) == ("flag", "number", "path")
    known = choices()
    assert {"fast", "accurate"} <= {name for name, _ in known["presets"]}
    for target in (*known["programs"], *known["formats"]):
        check(["export", "run", "--to", target])
    with pytest.raises(GsbaError, match="has no option nope"):
        Form("refine", "", ()).arguments({"nope": 1})


def wait_for(client: TestClient, job: str) -> dict[str, Any]:
    ended, url = ("done", "partial", "failed", "lost", "stopped"), f"api/jobs/{job}"
    until(lambda: client.get(url).json()["status"] in ended, 120)
    return client.get(url).json()


@pytest.mark.parametrize(
    ("command", "values", "run"),
    [
        ("add", {"run": "old", "new": ["frames"]}, "old"),
        ("add", {"run": "old", "new": ["frames"], "out": "new"}, "new"),
        ("merge", {"runs": ["old", "other"], "out": "both"}, "both"),
        ("remove", {"run": "old", "names": ["upper floor"]}, "old"),
    ],
)
def test_a_job_that_grows_a_run_leads_to_its_result(
    command: str,
    values: dict[str, Any],
    run: str,
    client: TestClient,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("gsba.app.routes.ensure_worker", lambda _: None)  # nothing is run
    added = post(client, "api/add", {"command": command, "values": values})
    assert added["run"] == run and added["command"].startswith(f"gsba {command} old ")


def test_a_job_that_fails_says_why(client: TestClient) -> None:
    values = {"run": "old", "names": ["upper floor"]}
    added = post(client, "api/add", {"command": "remove", "values": values})
    error = "old is not a gsba run: give the folder that gsba refine wrote"
    assert wait_for(client, added["id"])["error"] == error


def test_a_run_of_the_page_is_that_of_the_command_line(case: Case, tmp_path: Path) -> None:
    """The page's own run of the tiny walk; then export, plot, report, and its files."""
    root = case.frames.parent
    app = App(root, tmp_path / "state", [form_of(name) for name in COMMANDS], choices(), check)
    client = TestClient(application(app), base_url=f"http://127.0.0.1:8360/{app.token}/")
    out = f"of-page-{tmp_path.name}"
    values = {"frames": case.frames.name, "trajectory": [case.slam.name], "out": out}
    values |= {"overrides": list(LIGHT)}
    added = post(client, "api/add", {"command": "refine", "values": values})
    found = wait_for(client, added["id"])
    assert found["status"] == "done", client.get(f"api/jobs/{added['id']}/log").text
    assert (root / out / "trajectory.tum").read_bytes() == (
        case.out / "trajectory.tum"
    ).read_bytes()
    titles = [stage["title"] for stage in found["progress"]["stages"]]
    assert "extract features" in titles
    plan = client.get(f"api/jobs/{added['id']}/map").json()
    assert len(plan["path"]) == len(read_trajectory(root / out / "trajectory.tum").timestamps)
    assert plan["points"] and len(plan["points"]) == len(plan["colors"])
    about = client.get("api/run", params={"path": out}).json()
    assert about["finished"] and about["summary"]["refined"] == len(plan["path"])
    report = client.get(f"files/{out}/report.html")
    assert report.headers["content-security-policy"].startswith("sandbox allow-scripts;")
    cloud = client.get(f"files/{out}/points.ply")
    assert cloud.headers["content-disposition"].startswith("attachment")
    exported = {"run": out, "to": "tum"}
    added = post(client, "api/add", {"command": "export", "values": exported})
    assert wait_for(client, added["id"])["status"] == "done" and (root / out / "tum").is_dir()
    app.close()


def test_a_run_that_was_refined_anew_is_shown_anew(
    app: App, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Shown:
        stopped = False

        def __init__(self, *_: object) -> None:
            self.address = f"view {len(made)}"
            made.append(self)

        def stop(self) -> None:
            self.stopped = True

    made = list[Shown]()
    monkeypatch.setattr("gsba.app.hub.load_scene", lambda run: None)
    monkeypatch.setattr("gsba.app.hub.serve_view", Shown)
    run = root / "walk"
    (run / "stages").mkdir()
    (run / "stages/reconstruction.npz").write_bytes(b"1")
    assert app.view(run) == app.view(run) == "view 0"
    (run / "stages/reconstruction.npz").write_bytes(b"22")
    assert app.view(run) == "view 1" and made[0].stopped and not made[1].stopped
