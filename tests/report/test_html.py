"""report.html: its numbers, that it needs nothing from outside, and that its script runs."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import export_scene as scene
import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation

from gsba.camera.cameras import ONE_CAMERA
from gsba.camera.sphere import bearings_from_erp
from gsba.config import RefineSettings
from gsba.disk import write_image
from gsba.report.html import add_scan, add_splats, figures, pictures, residual_sphere, write_html
from gsba.report.html.patches import worst_patches
from gsba.report.report import Findings, StageLog, build_report
from gsba.store.store import StageRecord
from gsba.types import CoarsePoses, Counts, FrameSet, PoseStatus, Reconstruction

ROUND = {
    "gate_sigmas": 6.0,
    "noise": 1.0,
    "observations": 81,
    "accepted": True,
    "reason": "converged",
    "iterations": [
        {"number": 0, "cost": 9.0, "costs": {"bearing": 8.0, "graph": 1.0}, "accepted": True},
        {"number": 1, "cost": 99.0, "costs": {}, "accepted": False},
        {"number": 2, "cost": 3.0, "costs": {"bearing": 2.0, "graph": 1.0}, "accepted": True},
    ],
}


STAGES = StageLog(
    [StageRecord("verify", "key", False, 1.5, 2.5, 300.0)],
    {"verify": [Counts(10, 7, "pairs", {"too few inliers": 3})]},
    [{"stage": "chain", "rounds": [ROUND, {**ROUND, "accepted": False}]}],
)


def _report(
    frames: FrameSet, coarse: CoarsePoses, result: Reconstruction, stages: StageLog, found: Findings
) -> dict:
    given = {"settings": RefineSettings(), "frames": frames, "coarse": coarse}
    given |= {"reconstruction": result, "stages": stages, "found": found}
    report = build_report(**given, gauge="the gauge of the trajectory")
    return report | {"residual_sphere": residual_sphere(result)}


def _write(folder: Path, frames: FrameSet, result: Reconstruction) -> tuple[Path, CoarsePoses]:
    before = result.world_T_rigs.copy()
    before[2, :3, 3] += [0.3, 0.0, 0.4]
    coarse = CoarsePoses(before, np.zeros(len(frames), np.uint8), 0.0)
    found = Findings(["a note with <b>markup</b> & </script>"])
    report = _report(frames, coarse, result, STAGES, found)
    path = folder / "report.html"
    write_html(path, frames, coarse, result, report)
    return path, coarse


class _Page(HTMLParser):
    """Elements, ids and the embedded data of a page; fails on elements left open."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: set[str] = set()
        self.attributes: list[tuple[str, str | None]] = []
        self.texts: dict[str, str] = {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += attrs
        self.ids |= {value for key, value in attrs if key == "id" and value}
        if tag not in ("meta", "img", "input", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        where = self.open[-1] if self.open else ""
        self.texts[where] = self.texts.get(where, "") + data


def _data(page: str) -> dict:
    text = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert text
    return json.loads(text[1], parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    frames = scene.panoramas(folder / "images")
    names = ('<script><img src="x">', *frames.names[1:])
    frames = dataclasses.replace(frames, names=names)
    result = scene.reconstruction()
    statuses = result.pose_statuses.copy()
    statuses[8] = PoseStatus.UNREFINED
    return _write(folder, frames, dataclasses.replace(result, pose_statuses=statuses))[0]


def test_page_is_whole_and_needs_nothing_else(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    parsed = _Page(text)
    assert parsed.open == []
    assert not re.search(r"/\*(STYLE|SCRIPT|DATA)\*/", text)
    links = [value or "" for key, value in parsed.attributes if key in ("src", "href")]
    assert links == []  # pictures come from the data
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|import\(", text)
    addresses = set(re.findall(r"https?://[^\"'\s]+", text))
    assert addresses <= {"http://www.w3.org/2000/svg"}  # a name, not a place
    assert "default-src 'none'" in text  # the browser would refuse, too
    script = parsed.texts["script"]
    used = set(re.findall(r'\bel\("([\w-]+)"\)', script))
    assert used <= parsed.ids, used - parsed.ids


def test_numbers_are_those_of_the_run(page: Path) -> None:
    data = _data(page.read_text(encoding="utf-8"))
    assert data["frames"]["name"][0] == '<script><img src="x">'
    np.testing.assert_allclose(data["frames"]["moved"], [0, 0, 0.5, *[0] * 6], atol=1e-6)
    assert data["frames"]["std"] == [None] * scene.NUM_FRAMES  # covariances are unknown
    assert data["frames"]["status"][8] == 1
    num_points = len(scene.POINTS)
    expected = num_points * (1 - np.eye(scene.NUM_FRAMES))
    np.testing.assert_array_equal(data["matches"]["cells"], expected)
    assert data["report"]["stages"][0]["counts"][0]["dropped"] == {"too few inliers": 3}
    assert len(data["worst"]) == pictures.NUM_PICTURES
    jpeg = np.frombuffer(base64.b64decode(data["worst"][0]["jpeg"]), np.uint8)
    assert cv2.imdecode(jpeg, cv2.IMREAD_COLOR).shape == (360, 720, 3)


def test_map_looks_from_above() -> None:
    """The axes are a rotation: level ones first, and up is where the rigs have it."""
    result = scene.reconstruction()
    coarse = CoarsePoses(result.world_T_rigs, np.zeros(scene.NUM_FRAMES, np.uint8), 0.0)
    found = figures.world_map(coarse, result)
    after, positions = np.array(found["after"]), result.world_T_rigs[:, :3, 3]
    gaps, true_gaps = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (after, positions))
    np.testing.assert_allclose(gaps, true_gaps, atol=1e-3)
    up = -result.world_T_rigs[:, :3, 1].mean(axis=0)
    heights = (positions - np.median(positions, axis=0)) @ (up / np.linalg.norm(up))
    np.testing.assert_allclose(after[:, 2], heights, atol=1e-3)
    assert np.ptp(after[:, 0]) >= np.ptp(after[:, 1])
    # Right-handed: seen from above, a turn to the left is one on the map.
    triple = np.linalg.det(after[1:4] - after[0]) / np.linalg.det(positions[1:4] - positions[0])
    assert triple == pytest.approx(1, abs=0.05)


def test_map_of_a_standing_camera() -> None:
    result = scene.reconstruction()
    poses = np.tile(np.eye(4), (scene.NUM_FRAMES, 1, 1))
    result = dataclasses.replace(result, world_T_rigs=poses)
    found = figures.world_map(CoarsePoses(poses, np.zeros(9, np.uint8), 0.0), result)
    assert np.isfinite(found["points"]).all() and not np.any(found["after"])


def test_residuals_have_a_direction() -> None:
    """A rig turned to the right and down sees everything too far left and up, by that angle."""
    result = scene.reconstruction()
    assert np.abs(figures.tangent_residuals(result)).max() < 1e-9
    rng = np.random.default_rng(2)
    pixels = rng.uniform([0, 0.3], [1, 0.7], (20_000, 2))
    seen = bearings_from_erp(pixels, 1, 1)
    shifted = bearings_from_erp(pixels + np.array([0.005, 0.02]) / np.pi, 1, 1)
    result = dataclasses.replace(
        result,
        points_world=7 * shifted,
        observation_points=np.arange(len(seen), dtype=np.int32),
        observation_frames=np.zeros(len(seen), np.int32),  # at the origin of the world
        observation_bearings=seen,
    )
    found = figures.tangent_residuals(result)
    level = np.hypot(seen[:, 0], seen[:, 2])
    np.testing.assert_allclose(found[:, 0], 0.01 * level, atol=4e-4)
    np.testing.assert_allclose(found[:, 1], 0.02, atol=4e-4)
    sphere = figures.residual_sphere(result)
    assert sphere["count"].sum() == len(seen) and sphere["median_deg"].shape == (36, 72)
    row = sphere["south_deg"][18]  # just below the horizon
    np.testing.assert_allclose(row, np.degrees(0.02), atol=0.02)
    np.testing.assert_allclose(sphere["east_deg"][18], np.degrees(0.01), atol=0.02)
    assert np.isnan(sphere["median_deg"][0]).all()  # nothing was seen at the zenith


def test_many_frames_share_a_cell() -> None:
    result = scene.reconstruction()
    num = 1000
    result = dataclasses.replace(
        result,
        world_T_rigs=np.tile(np.eye(4), (num, 1, 1)),
        observation_frames=np.array([0, 4, 999], np.int32),
        observation_points=np.array([1, 1, 1], np.int32),
        observation_bearings=np.tile([0.0, 0, 1], (3, 1)),
    )
    found = figures.match_matrix(result)
    cells, step = found["cells"], found["frames_per_cell"]
    assert (step, cells.shape) == (5, (200, 200))
    assert cells[0, 0] == 2 and cells[0, 199] == 2 and cells.sum() == 6


def test_frames_that_came_as_faces(tmp_path: Path) -> None:
    frames, result = scene.cube_frames(tmp_path / "cube"), scene.reconstruction()
    image = pictures.small_panorama(frames, 0, 720)
    bearing = scene.POINTS[0] / np.linalg.norm(scene.POINTS[0])  # frame 0 is the world
    u = 720 * (np.arctan2(bearing[0], bearing[2]) / (2 * np.pi) + 0.5)
    v = 360 * (0.5 + np.arcsin(bearing[1]) / np.pi)
    colour = image[int(v), int(u)].astype(int)
    assert np.abs(colour - scene.COLORS[0]).max() < 40
    assert not image[0].any()  # no face up
    path, _ = _write(tmp_path, frames, result)
    assert _data(path.read_text(encoding="utf-8"))["erp_width"] == 4 * frames.format.width


def test_a_picture_that_vanished_is_left_out(tmp_path: Path) -> None:
    frames = scene.panoramas(tmp_path / "images")
    frames.paths[0][0].unlink()
    path, _ = _write(tmp_path, frames, scene.reconstruction())
    worst = _data(path.read_text(encoding="utf-8"))["worst"]
    assert 0 not in [entry["frame"] for entry in worst] and worst


def test_nothing_was_refined(tmp_path: Path) -> None:
    result = scene.reconstruction()
    nothing = dataclasses.replace(
        result,
        points_world=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8),
        observation_points=np.zeros(0, np.int32),
        observation_frames=np.zeros(0, np.int32),
        observation_bearings=np.zeros((0, 3)),
        observation_sigmas=np.zeros(0),
    )
    path, _ = _write(tmp_path, scene.panoramas(tmp_path / "images"), nothing)
    assert _data(path.read_text(encoding="utf-8"))["worst"] == []
    _run_script(path)


def _run_script(path: Path) -> list:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node, which runs the page's script, is not installed")
    stub = Path(__file__).with_name("page_stub.cjs")
    done = subprocess.run([node, str(stub), str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_several_maps_are_listed_and_the_largest_is_drawn(tmp_path: Path) -> None:
    frames, result = scene.panoramas(tmp_path / "images"), scene.reconstruction()
    result = dataclasses.replace(
        result,
        components=np.array([0, 0, 0, 0, 0, 1, 1, 2, 0], np.int32),
        pose_statuses=np.where(np.arange(9) == 8, PoseStatus.UNREFINED, PoseStatus.REFINED),
    )
    coarse = CoarsePoses(result.world_T_rigs, np.zeros(len(frames), np.uint8), 0.0)
    found = Findings(reasons=("", "</script> two surfaces"))
    report = _report(frames, coarse, result, StageLog(), found)
    rows, path = result.largest_map(), tmp_path / "report.html"
    own = dataclasses.replace(
        coarse, world_T_rigs=coarse.world_T_rigs[rows], sources=coarse.sources[rows]
    )
    write_html(path, frames.taken(rows), own, result.of_map(1), report)
    *_, apart, maps = _run_script(path)
    assert apart == "1 with the pose of the trajectory file, 2 in other maps, 1 in no map"
    assert maps[0][0] == "Map" and maps[0][-1] == "Reason why it was not joined"
    names = frames.names
    assert maps[1][:4] == ["1", "6", "5", "4"] and maps[2][:4] == ["2", "2", "2", "1"]
    assert maps[1][-2:] == [f"{names[0]} to {names[4]}, {names[8]}", ""]
    assert maps[2][-2:] == [f"{names[5]} to {names[6]}", "</script> two surfaces"]


def test_script_runs(page: Path) -> None:
    tiles, title, worst, rows, note, apart, maps = _run_script(page)
    assert apart == "1 with the pose of the trajectory file" and maps is None
    assert (tiles, title, worst, rows) == (6, page.parent.name, pictures.NUM_PICTURES, 2)
    assert note == ["a note with <b>markup</b> & </script>"]  # a text, not markup


def _patches(frames: FrameSet, result: Reconstruction) -> list:
    found = worst_patches(frames, result, ONE_CAMERA, pictures.worst_frames(result))
    assert all(entry["frame"] != entry["reference"] for entry in found)
    return found


def test_patches_show_what_does_not_fit(tmp_path: Path) -> None:
    frames, result = scene.panoramas(tmp_path / "images"), scene.reconstruction()
    right = _patches(frames, result)
    assert len(right) == pictures.NUM_PICTURES
    assert min(entry["correlation"] for entry in right) > 0.95
    turned = result.world_T_rigs.copy()
    turned[4, :3, :3] @= Rotation.from_euler("y", 2, degrees=True).as_matrix()
    wrong = _patches(frames, dataclasses.replace(result, world_T_rigs=turned))
    assert wrong[0]["frame"] == 4 and wrong[0]["correlation"] < 0.7
    assert wrong[0]["residual_deg"] == pytest.approx(2, abs=0.1)
    png = np.frombuffer(base64.b64decode(wrong[0]["png"]), np.uint8)
    patches = np.asarray(cv2.imdecode(png, cv2.IMREAD_GRAYSCALE), int)
    assert patches.shape == (25, 75)
    # 2 degrees to the right, the point lies 3 pixels to the left of where it is predicted
    columns = [int(patch.mean(axis=0).argmax()) for patch in np.split(patches, 3, axis=1)[:2]]
    assert abs(columns[0] - columns[1]) == 3
    frames.paths[4][0].unlink()
    assert 4 not in [entry["frame"] for entry in _patches(frames, result)]


def test_terms_of_the_page_are_those_of_the_glossary(page: Path) -> None:
    listed = re.findall(r'^  "?([a-zσ ]+)"?: "(.+)",$', page.read_text(encoding="utf-8"), re.M)
    glossary = (Path(__file__).parents[2] / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = re.sub(r"\[([^]]+)\]\([^)]*\)", r"\1", glossary)
    assert {"carrier", "gauge", "strength", "map unit", "σ"} <= dict(listed).keys()
    assert [row for row in listed if f"| {row[0]} | {row[1]} |" not in rows] == []


def test_distances_to_a_scan_are_added(page: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    shutil.copy(page, path)
    part = {"points": 10, "median": 0.25, "percentile90": 1.5, "explained": 0.5}
    part |= {"histogram": {"edges": [0.0, 1.0, 2.0], "counts": [8, 1, 1]}}
    for before in (part, None):
        add_scan(path, {"scan": "hall.laz", "before": before, "after": part, "points": {}})
        shown = {"scan": "hall.laz", "before": before, "after": part}
        assert _data(path.read_text(encoding="utf-8"))["scan"] == shown
        assert _run_script(path)[0] == 6
    add_scan(tmp_path / "none.html", {})  # no page, nothing to do
    path.write_text("<html>")
    refused("is not the report page of a run", add_scan, path, {})


def _over(path: Path) -> list[tuple[str, int]]:
    """Names and grey values of the pictures that lie over one another."""
    shown = _data(path.read_text(encoding="utf-8"))["splat"]
    jpegs = [np.frombuffer(base64.b64decode(one["jpeg"]), np.uint8) for one in shown["pictures"]]
    images = [np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)) for jpeg in jpegs]
    assert [(w, h) for h, w in (image.shape for image in images)] == [(1080, 180)] * 2
    names = [one["name"] for one in shown["pictures"]]
    return [(name, round(image.mean())) for name, image in zip(names, images, strict=True)]


def test_splats_before_and_after_lie_over_one_another(page: Path, tmp_path: Path) -> None:
    path, picture = tmp_path / "report.html", tmp_path / "frame_0004.jpg"
    shutil.copy(page, path)
    for sources, before in (
        (["refined"], ("captured", 50)),
        (["refined", "slam"], ("splat on slam poses", 150)),
    ):
        rows = np.repeat(np.uint8([50, 100, 150])[: 1 + len(sources)], 32)
        write_image(picture, np.tile(rows[:, None, None], (1, 192, 3)))
        add_splats(path, picture, sources)
        assert _over(path) == [before, ("splat on refined poses", 100)]
        assert _run_script(path)[0] == 6


def test_a_page_written_again_keeps_splats_and_scan_of_the_same_map(tmp_path: Path) -> None:
    frames, result = scene.panoramas(tmp_path / "images"), scene.reconstruction()
    path, _ = _write(tmp_path, frames, result)
    picture = tmp_path / "000003.png"
    write_image(picture, np.full((64, 192, 3), 90, np.uint8))
    add_splats(path, picture, ["refined"])
    content = {"scan": "hall.ply", "after": {"median": 1.0}}
    add_scan(path, content)
    _write(tmp_path, frames, result)
    kept = _data(path.read_text(encoding="utf-8"))
    assert kept["splat"]["frame"] == "000003" and kept["scan"] == content
    moved = result.world_T_rigs.copy()
    moved[1, :3, 3] += 0.5
    _write(tmp_path, frames, replace(result, world_T_rigs=moved))
    other = _data(path.read_text(encoding="utf-8"))
    assert other["splat"] is None and other["scan"] is None


def test_browser_shows_it(page: Path) -> None:
    """Headless Chromium, offline: no error, no request, the map answers wheel, drag and pointer."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    executable = next(filter(None, map(shutil.which, names)), None)
    with api.sync_playwright() as driver:
        if executable is None and not Path(driver.chromium.executable_path).exists():
            pytest.skip("no Chromium is installed")
        browser = driver.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        size = {"width": 1280, "height": 1000}
        tab = browser.new_context(offline=True, color_scheme="dark", viewport=size).new_page()
        troubles: list[str] = []
        tab.on("pageerror", lambda error: troubles.append(str(error)))
        tab.on("console", lambda message: troubles.append(message.text))
        tab.on("request", lambda request: troubles.append(request.url[:80]))
        tab.goto(page.as_uri())
        tab.wait_for_timeout(300)
        assert tab.locator(".tile").count() == 6 and tab.locator("#worst img").count() == 6
        assert tab.evaluate("document.documentElement.dataset.theme") == "dark"
        assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert tab.locator("#verdict .chip").count() == tab.locator(".chip img").count() == 3
        code = tab.locator("#verdict code").first
        assert code.inner_text() == f"gsba export {page.parent} --to colmap --without doubted"
        tab.locator("#verdict .command button").first.click()
        tab.wait_for_timeout(50)
        copied = tab.locator("#verdict button", has_text="Copied").count()
        assert copied or tab.evaluate("getSelection().toString()") == code.inner_text()
        tab.locator("footer a", has_text="gauge").click()
        assert tab.evaluate("document.querySelector(':target').textContent") == "gauge"
        chart = tab.locator("#top")
        chart.scroll_into_view_if_needed()
        box = chart.bounding_box()
        pictures_seen = [chart.screenshot()]
        tab.mouse.move(box["x"] + 90, box["y"] + 300)
        for act in (
            lambda: tab.mouse.wheel(0, -300),
            lambda: (
                tab.mouse.down(),
                tab.mouse.move(box["x"] + 140, box["y"] + 340),
                tab.mouse.up(),
            ),
            lambda: tab.locator("#theme").click(),
        ):
            act()
            tab.wait_for_timeout(150)
            pictures_seen.append(chart.screenshot())
        assert len(set(pictures_seen)) == 4  # zoomed, moved, lit
        tab.locator("#series canvas").first.hover()
        tab.wait_for_timeout(150)
        assert "residual" in tab.locator("#tip").inner_text()
        browser.close()
    allowed = (page.as_uri()[:80], "data:image/jpeg;base64,")
    assert [text for text in troubles if not text.startswith(allowed)] == []
