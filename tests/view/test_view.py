"""`gsba view`: what is in the scene, where it is, who can reach it, and how it fails."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command import run_gsba
from pixels import pixel_centres
from scipy.spatial.transform import Rotation
from tiny_run import NUM_FRAMES, Case

from gsba import view
from gsba.camera.rig import RIG_R_FACE, CubeRig
from gsba.export import ExportFormat, ExportOptions, export_all
from gsba.geometry import rotation_from_quaternion
from gsba.log import GsbaError
from gsba.placement.world import Placement, read_placement
from gsba.similarity import Sim3
from gsba.splat import Gaussians, read_ply, write_ply
from gsba.types import FACES, Reconstruction

TURN = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
PLACED = Placement(Sim3(2.5, TURN, np.array([3.0, -1.0, 7.0])), "m", "z")


@pytest.fixture(scope="module")
def run(case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a splat of three Gaussians."""
    out = case.copy(tmp_path_factory.mktemp("view") / "walk")
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(3, 4)).astype(np.float32)
    scales = np.log(rng.uniform(0.01, 0.3, (3, 3))).astype(np.float32)
    means, sh = rng.normal(size=(3, 3)), rng.normal(size=(3, 4, 3))
    splat = Gaussians(
        means.astype(np.float32),
        scales,
        quaternions,
        np.array([-1, 0, 2], np.float32),
        sh.astype(np.float32),
    )
    (out / "splat" / "refined").mkdir(parents=True)
    report = json.loads((out / "report.json").read_text()) | {"start": "odometry"}
    (out / "report.json").unlink()  # a link to the case's
    (out / "report.json").write_text(json.dumps(report))
    write_ply(out / "splat" / "refined" / "point_cloud.ply", splat)
    return out


@pytest.fixture(scope="module")
def scene(run: Path) -> view.RunScene:
    return view.load_scene(run)


@pytest.fixture
def shown(scene: view.RunScene) -> Iterator[view.SceneView]:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'gsba[view]'")
    started = view.serve(scene, 0)
    yield started
    started.stop()


def test_the_scene_is_the_run(case: Case, scene: view.RunScene) -> None:
    found = case.result.reconstruction
    assert np.array_equal(scene.reconstruction.world_T_rigs, found.world_T_rigs)
    assert np.array_equal(scene.reconstruction.points_world, found.points_world)
    assert scene.coarse_T_rigs is not None
    assert np.allclose(scene.coarse_T_rigs, case.result.coarse.world_T_rigs, atol=1e-8)
    assert (scene.unit, scene.name) == ("map units", "walk")
    assert np.dot(scene.up, -found.world_T_rigs[:, :3, 1].mean(axis=0)) > 0.99
    steps = np.linalg.norm(np.diff(found.world_T_rigs[:, :3, 3], axis=0), axis=1)
    assert scene.step == pytest.approx(np.median(steps))


def test_the_scene_is_placed_as_the_latest_export(run: Path, scene: view.RunScene) -> None:
    first, second = run / "first", run / "second"
    first.mkdir()
    second.mkdir()
    PLACED.write(first / "transform.json")
    os.utime(first / "transform.json", ns=(2**61, 2**61))  # after any export so far
    Placement().write(second / "transform.json")  # moves nothing: does not count
    os.utime(second / "transform.json", ns=(2**61 + 1, 2**61 + 1))
    try:
        placed = view.load_scene(run)
    finally:
        shutil.rmtree(first)
        shutil.rmtree(second)
    assert (placed.unit, placed.grounds) == ("m", "placed as in first")
    assert placed.up.tolist() == [0, 0, 1]
    assert placed.step == pytest.approx(2.5 * scene.step)
    for before, after in (
        (scene.reconstruction.points_world, placed.reconstruction.points_world),
        (scene.splats[0].means, placed.splats[0].means),
        (_positions(scene.coarse_T_rigs), _positions(placed.coarse_T_rigs)),
    ):
        assert np.allclose(after, PLACED.similarity.points(before.astype(np.float64)), atol=1e-5)
    turned = 2.5**2 * TURN @ scene.splats[0].covariances @ TURN.T
    assert np.allclose(placed.splats[0].covariances, turned, rtol=1e-4, atol=1e-6)
    assert np.allclose(placed.coarse_T_rigs[:, :3, :3], TURN @ scene.coarse_T_rigs[:, :3, :3])


def test_a_map_is_not_placed_as_an_earlier_one_was(
    run: Path, scene: view.RunScene, caplog: pytest.LogCaptureFixture
) -> None:
    """After a run was refined anew, exports of before have another unit, up and place."""
    out, options = run / "metric", ExportOptions(placement=PLACED)
    for poses, unit in ((scene.reconstruction, "m"), (_moved(scene.reconstruction), "map units")):
        export_all(poses, scene.frames, {ExportFormat.PLY: out}, options)
        try:
            assert view.load_scene(run).unit == unit
        finally:
            shutil.rmtree(out)
    assert "places an earlier map of the run: export again" in caplog.text


def _moved(reconstruction: Reconstruction) -> Reconstruction:
    return replace(reconstruction, world_T_rigs=reconstruction.world_T_rigs + 1e-3)


def _positions(poses: np.ndarray | None) -> np.ndarray:
    return poses[:, :3, 3]


def test_gaussians_are_what_the_file_says(run: Path, scene: view.RunScene) -> None:
    stored, (shown_splat,) = read_ply(run / "splat/refined/point_cloud.ply"), scene.splats
    assert shown_splat.name == "refined"
    for i in range(3):
        q = stored.quaternions[i].astype(np.float64)
        axes = rotation_from_quaternion(q / np.linalg.norm(q))
        wanted = axes @ np.diag(np.exp(2.0 * stored.log_scales[i])) @ axes.T
        assert np.allclose(shown_splat.covariances[i], wanted, rtol=1e-4, atol=1e-8)
    sigmoid = 1 / (1 + np.exp([1.0, 0, -2]))
    assert np.allclose(shown_splat.opacities[:, 0], sigmoid, atol=1e-6)
    wanted = np.clip(0.5 + 0.28209479 * stored.sh[:, 0], 0, 1)
    assert np.allclose(shown_splat.colors, wanted, atol=1e-6)


def test_placements_survive_their_file(tmp_path: Path) -> None:
    placed = replace(PLACED, offset=np.array([5e5, 1, 2]), origin=(48.1, 11.5, 520.0))
    placed.write(tmp_path / "transform.json")
    assert read_placement(tmp_path / "transform.json").to_json() == placed.to_json()
    for content in ("{}", "no json", "[1]", json.dumps({**PLACED.to_json(), "rotation": [1]})):
        (tmp_path / "transform.json").write_text(content)
        with pytest.raises(GsbaError, match=r"transform\.json is not a transform\.json of gsba"):
            read_placement(tmp_path / "transform.json")


def test_pictures_are_tinted_where_masks_are(case: Case, tmp_path: Path) -> None:
    frames = case.result.frames
    mask = np.full((frames.format.height, frames.format.width), 255, np.uint8)
    mask[5 * frames.format.height // 8 :] = 0  # 22.5 degrees below the horizon and further down
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    masked = replace(frames, mask_paths=(tmp_path / "mask.png",) * len(frames))
    plain, tinted = view.faces_of(masked, 0, False), view.faces_of(masked, 0, True)
    assert tuple(plain) == FACES and plain["front"].shape == (128, 128, 3)
    pixels = pixel_centres(128, 128)
    for c, name in enumerate(FACES):
        below = np.degrees(np.arcsin(CubeRig(128, np.pi / 2).bearings(pixels, c)[..., 1])) - 22.5
        changed = np.any(plain[name] != tinted[name], axis=-1)
        sure = np.abs(below) > 1  # degree: more than the mask's pixel
        assert np.array_equal(changed[sure], below[sure] > 0), name
    unmasked = view.faces_of(frames, 0, True)
    assert all(np.array_equal(unmasked[name], plain[name]) for name in FACES)


def test_everything_is_on_show(scene: view.RunScene, shown: view.SceneView) -> None:
    nodes = shown.nodes
    wanted = {"/cloud", "/refined", "/coarse", "/rigs", "/axes", "/frame", "/seen"}
    assert nodes.keys() == wanted | {"/splat/refined"}
    assert len(nodes["/cloud"].points) == len(scene.reconstruction.points_world)
    assert len(nodes["/refined"].points) == len(nodes["/coarse"].points) == NUM_FRAMES - 1
    assert len(nodes["/rigs"].batched_positions) == NUM_FRAMES
    assert len(nodes["/axes"].batched_positions) == NUM_FRAMES
    positions = shown.scale * scene.reconstruction.world_T_rigs[:, :3, 3]
    assert np.allclose(nodes["/rigs"].batched_positions, positions, atol=1e-5)
    assert shown.scale * scene.step == pytest.approx(1)
    switches = {"Refined trajectory", "Start: odometry", "Rigs", "Cloud", "Splat refined"}
    assert switches < shown.controls.keys()
    assert not shown.controls["Masks"].visible  # there are none


def test_switches_show_and_hide(shown: view.SceneView) -> None:
    for label, name in (("Start: odometry", "/coarse"), ("Splat refined", "/splat/refined")):
        before = shown.nodes[name].visible
        shown.controls[label].value = not before
        _wait_for(lambda name=name, before=before: shown.nodes[name].visible == (not before))


def test_a_clicked_rig_shows_its_pictures(scene: view.RunScene, shown: view.SceneView) -> None:
    shown._select(3)
    _wait_for(lambda: shown.frame == 3)
    world_T_rig = scene.reconstruction.world_T_rigs[3]
    node = shown.nodes["/frame"]
    assert np.allclose(node.position, shown.scale * world_T_rig[:3, 3])
    assert np.allclose(rotation_from_quaternion(node.wxyz), world_T_rig[:3, :3], atol=1e-6)
    seen = scene.reconstruction.observation_frames == 3
    assert len(shown.nodes["/seen"].points) == seen.sum() > 0
    assert f"**{scene.frames.names[3]}**" in shown.controls["about"].content
    assert shown._faces.keys() == set(FACES)
    for name, face in shown._faces.items():
        turn = rotation_from_quaternion(face.wxyz)
        assert np.allclose(turn, RIG_R_FACE[FACES.index(name)], atol=1e-6)


def test_a_frame_whose_picture_is_gone_says_so(scene: view.RunScene) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'gsba[view]'")
    gone = (*scene.frames.paths[:-1], (Path("nowhere.jpg"),))
    shown = view.serve(replace(scene, frames=replace(scene.frames, paths=gone)), 0)
    try:
        shown.show(NUM_FRAMES - 1)
        assert "No image: nowhere.jpg" in shown.controls["about"].content
        assert not shown._faces
        shown.show(0)
        assert len(shown._faces) == 6
    finally:
        shown.stop()


def test_only_this_machine_is_served(shown: view.SceneView) -> None:
    port = shown.server.get_port()
    assert shown.server.get_host() == "127.0.0.1"
    assert {address for address, at in _listening() if at == port} == {"127.0.0.1"}
    with urllib.request.urlopen(shown.address, timeout=10) as page:
        assert page.status == 200
    assert shown.server.request_share_url() is None  # no tunnel, whoever asks


def _head(shown: view.SceneView, path: str, *lines: str) -> str:
    """First line of the answer to a request."""
    port = shown.server.get_port()
    request = [f"GET {path} HTTP/1.1", *(line.format(port=port) for line in lines), "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall("\r\n".join(request).encode())
        return connection.recv(4096).decode(errors="replace").splitlines()[0]


LOCAL, UPGRADE = (
    "Host: 127.0.0.1:{port}",
    (
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    ),
)


def test_other_pages_of_the_browser_get_nothing(shown: view.SceneView) -> None:
    """Neither by the address of this machine, nor by a name of theirs that points to it."""
    path = "/" + shown.address.split("/", 3)[3]
    own = "Origin: http://127.0.0.1:{port}"
    for kind, good in (((), "200"), (UPGRADE, "101")):
        assert good in _head(shown, path, LOCAL, *kind)
        assert good in _head(shown, path.rstrip("/"), LOCAL, own, *kind)
        assert good in _head(
            shown, path, "Host: localhost:9000", "Origin: http://localhost:9000", *kind
        )
        for refused in (
            ("Host: evil.example:{port}", "Origin: http://evil.example:{port}"),
            ("Host: evil.example:{port}",),
            ("Host: 127.0.0.1.evil.example",),
            ("Host: evil.example@127.0.0.1:{port}",),
            (LOCAL, "Origin: http://evil.example"),
            (LOCAL, "Origin: null"),
            (LOCAL, "Origin: http://127.0.0.1:1"),
            (LOCAL, "Host: evil.example"),
        ):
            assert "403" in _head(shown, path, *refused, *kind), refused
        for other in ("/", "/index.html", path[:-2] + "/", path[:-1] + "x/", "/x" + path):
            assert "403" in _head(shown, other, LOCAL, own, *kind), other
    assert len(path) > 20


def test_the_token_is_another_each_time(scene: view.RunScene, shown: view.SceneView) -> None:
    second = view.serve(scene, 0)
    second.stop()
    assert second.address.split("/")[3] != shown.address.split("/")[3]


def test_a_viser_that_cannot_be_guarded_is_refused(
    scene: view.RunScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'gsba[view]'")
    monkeypatch.setattr("gsba.view.server.guarded", lambda token: nullcontext([]))
    with pytest.raises(GsbaError, match="cannot be protected from other web pages"):
        view.serve(scene, 0)


def _listening() -> set[tuple[str, int]]:
    """Addresses and ports of all listening IPv4 sockets, and of IPv6 ones as ("::", port)."""
    found = set()
    for name in ("tcp", "tcp6"):
        table = Path("/proc/net") / name
        for row in table.read_text().splitlines()[1:] if table.exists() else ():
            local, state = row.split()[1], row.split()[3]
            host, port = local.split(":")
            if state == "0A":
                address = "::" if name == "tcp6" else socket.inet_ntoa(bytes.fromhex(host)[::-1])
                found.add((address, int(port, 16)))
    return found


def _wait_for(happened, seconds: float = 10.0) -> None:
    """Callbacks run in threads of their own."""
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def _view_fails(*arguments: object) -> str:
    result = run_gsba("view", *arguments)
    lines = result.stderr.splitlines()
    assert (result.exit_code, result.stdout, len(lines)) == (1, "", 1), result.stderr
    return lines[0]


def test_a_port_in_use_is_one_line(run: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'gsba[view]'")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = _view_fails(run, "--port", port)
    assert line == (
        f"error: port {port} of 127.0.0.1 is in use: pass another --port, or 0 for any free one"
    )
    assert "out of range" in _view_fails(run, "--port", 70000)


def test_without_viser_there_is_a_hint(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'gsba[view]'" in _view_fails(run, "--port", 0)


def test_no_run_and_half_a_run_are_one_line(run: Path, tmp_path: Path) -> None:
    assert "is not a gsba run" in _view_fails(tmp_path / "nothing")
    half = Path(shutil.copytree(run, tmp_path / "half"))
    (half / "stages/reconstruction.npz").unlink()
    assert "to the end" in _view_fails(half)
    broken = Path(shutil.copytree(run, tmp_path / "broken"))
    (broken / "splat/refined/point_cloud.ply").write_bytes(b"ply\n")
    assert "point_cloud.ply" in _view_fails(broken)


def test_ctrl_c_ends_it_quietly(run: Path) -> None:
    pytest.importorskip("viser", reason="viser is not installed: pip install 'gsba[view]'")
    script = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"from gsba.cli import app; app(['view', {str(run)!r}, '--port', '0'])"
    )
    root = Path(view.__file__).parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(root), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        first = process.stdout.readline()
        assert first.startswith("http://127.0.0.1:") and "Ctrl-C ends it" in first
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert (process.returncode, rest.strip(), errors) == (0, "", "")


def test_distances_to_a_scan_colour_the_points(run: Path, scene: view.RunScene) -> None:
    num, path = len(scene.reconstruction.points_world), run / "scan.json"
    points = {"of": num, "furthest": 1.0, "rows": [2, 0], "distances": [0.0, 5.0]}
    assert scene.judged is None
    try:
        path.write_text(json.dumps({"points": points}))
        judged = view.load_scene(run).judged
        np.testing.assert_array_equal(judged[0], scene.reconstruction.points_world[[2, 0]])
        assert judged[1][0, 2] > judged[1][0, 0] and judged[1][1, 0] > judged[1][1, 2]
        path.write_text(json.dumps({"points": points | {"of": num + 1}}))
        assert view.load_scene(run).judged is None  # of an earlier run
        path.write_text("{}")
        with pytest.raises(GsbaError, match=r"scan\.json: cannot be read"):
            view.load_scene(run)
    finally:
        path.unlink()
