"""A person's way through the page in a real browser, from a video to a dataset.

With GSBA_PICTURES=FOLDER the pictures of docs/app.md are written to that folder.
"""

import base64
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from gsba.demo.walk import make_film

pytest.importorskip("starlette")
pytest.importorskip("uvicorn")
pytest.importorskip("av")
pytest.importorskip("viser")
pytest.importorskip("matplotlib")
sync_api = pytest.importorskip("playwright.sync_api")

pytestmark = pytest.mark.slow

BROWSER = next((p for name in ("chromium", "chromium-browser") if (p := shutil.which(name))), None)
GSBA = (sys.executable, "-c", "from gsba.cli import main; main()")
DESK, PHONE = {"width": 1100, "height": 800}, {"width": 390, "height": 844}
RUN_MS = 540_000  # a run on a busy machine
COUNT_CLICKS = """
window.clicks = 0;
addEventListener("click", (event) => { if (event.isTrusted) window.clicks += 1; }, true);
"""
NAMELESS = """
[...document.querySelectorAll("button, a, input, select, canvas, img, progress")].filter((one) => {
  const labelled = one.labels && [...one.labels].some((label) => label.textContent.trim());
  const named = one.getAttribute("aria-label") || one.textContent.trim() || one.hasAttribute("alt");
  return !one.hidden && !labelled && !named;
}).map((one) => one.outerHTML)
"""


@dataclass
class Server:
    """`gsba app` as its own process, which can be killed and started again."""

    root: Path
    state: Path
    port: int = 0
    process: subprocess.Popen[str] = field(init=False)
    address: str = field(init=False)

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [*GSBA, "app", ".", "--port", str(self.port), "--state", str(self.state)],
            cwd=self.root,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        found = re.search(r"http://127\.0\.0\.1:(\d+)/\S+", self.process.stdout.readline())
        self.address, self.port = found[0], int(found[1])

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if BROWSER is None:
        pytest.skip("no chromium here: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        software_gl = ["--no-sandbox", "--enable-unsafe-swiftshader"]  # no GPU on test machines
        shown = playwright.chromium.launch(executable_path=BROWSER, args=software_gl)
        yield shown
        shown.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    root = tmp_path_factory.mktemp("page") / "footage"
    make_film(root, num_frames=60, width=512)
    started = Server(root, root.parent / "state")
    yield started
    started.kill()


def opened(browser: Any, address: str, size: dict[str, int]) -> Any:
    """A page; errors of its console fail the test that looks at `page.faults`."""
    page = browser.new_page(viewport=size)
    page.set_default_timeout(RUN_MS)  # a busy machine is no fault of the page
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("requestfailed", lambda request: page.faults.append(f"{request.url} failed"))
    page.goto(address)
    return page


def picture(page: Any, name: str) -> None:
    if folder := os.environ.get("GSBA_PICTURES"):
        # The folder of a test is nobody's.
        page.evaluate("scrollTo(0, 0); document.getElementById('root').textContent = '~/footage'")
        page.screenshot(path=f"{folder}/{name}.jpg", type="jpeg", quality=80)


def chosen(page: Any, out: str) -> None:
    """Choose the video in the list, and name the run."""
    row(page, "walk.mp4").click()
    page.locator("dd", has_text="stitched panoramas, 512x256").wait_for()
    page.locator("#field-out").fill(out)
    page.locator("#command", has_text=f"--out {out}").wait_for()


def row(page: Any, name: str) -> Any:
    """Row of a list of files; its facts and its picture come later."""
    return page.locator(".files button", has=page.get_by_text(name, exact=True))


def dropped(page: Any, name: str, content: bytes | int, modified: int = 1_700_000_000_000) -> None:
    """Drop a file onto the page, of these bytes or of this number of zeros."""
    text = base64.b64encode(content).decode() if isinstance(content, bytes) else ""
    page.evaluate(
        """([name, text, size, modified]) => {
          const read = () => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
          const bytes = text ? read() : new Uint8Array(size);
          const dataTransfer = new DataTransfer();
          dataTransfer.items.add(new File([bytes], name, { lastModified: modified }));
          const options = { dataTransfer, bubbles: true, cancelable: true };
          document.body.dispatchEvent(new DragEvent("dragover", options));
          document.body.dispatchEvent(new DragEvent("drop", options));
        }""",
        [name, text, content if isinstance(content, int) else 0, modified],
    )


def status(page: Any, text: str) -> None:
    page.locator(f".badge.{text}").first.wait_for()


def fits(page: Any) -> bool:
    return page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def figures_are_drawn(page: Any) -> None:
    page.get_by_role("heading", name="Figures", exact=True).wait_for()
    page.locator("img").last.scroll_into_view_if_needed()
    page.wait_for_function("[...document.images].every(i => i.complete && i.naturalWidth > 200)")


def test_from_a_video_to_a_dataset(browser: Any, server: Server) -> None:
    page = opened(browser, server.address, DESK)
    page.get_by_text("stitched panoramas, 512x256 · 7.5 s, 60 frames").wait_for()
    page.locator(".files .shot img").wait_for()
    picture(page, "app-files")
    chosen(page, "first")
    page.get_by_text("Drag to look around.").wait_for()
    page.get_by_text("Fast", exact=True).click()
    page.locator("#command", has_text="--config fast").wait_for()
    picture(page, "app-new")
    line = page.locator("#command").text_content()
    page.get_by_role("button", name="Start").click()
    status(page, "running")
    page.get_by_text("From above").wait_for()
    drawn = page.locator("canvas[aria-label*=' poses']")  # the path grows while the run goes on
    drawn.wait_for()
    status(page, "running")
    # A second page shows the same job; on a phone nothing is cut off.
    phone = opened(browser, f"{server.address}#jobs", PHONE)
    status(phone, "running")
    phone.get_by_role("link", name="refine first").click()
    phone.get_by_role("heading", name="Stages").wait_for()
    assert fits(phone)
    page.locator(".stages li").nth(12).wait_for()
    page.locator("canvas.panorama[data-shown*='frame=']").wait_for()
    picture(page, "app-watch")
    # The server is killed: the run goes on, both pages say so and find the next server.
    server.kill()
    page.locator("#offline").wait_for()
    phone.locator("#offline").wait_for()
    server.start()
    page.locator("#offline").wait_for(state="hidden")
    phone.locator("#offline").wait_for(state="hidden")
    status(page, "done")
    page.get_by_text("frames refined").first.wait_for()
    phone.get_by_text("frames refined").first.wait_for()
    picture(phone, "app-phone")
    assert fits(page) and fits(phone)
    with page.context.expect_page() as report:
        page.get_by_role("link", name="Report").click()
    report.value.wait_for_load_state()
    assert report.value.locator("svg, canvas").count() > 0  # its script runs in the sandbox
    done = page.url
    with page.context.expect_page() as viewer:
        page.get_by_role("button", name="Open the viewer").click()
    viewer.value.locator("canvas").first.wait_for()
    viewer.value.close()
    page.locator("main a[href^='http://127.0.0.1:']").wait_for()
    page.get_by_role("button", name="Plot", exact=True).click()
    page.get_by_role("heading", name="plot first").wait_for()
    status(page, "done")
    figures_are_drawn(page)
    page.goto(done)
    page.locator("main").get_by_role("link", name="Compare", exact=True).click()
    page.get_by_role("columnheader", name="first").wait_for()
    page.goto(done)
    page.get_by_role("button", name="Merge with a run").click()
    row(page, "first").click()
    page.get_by_role("button", name="Take this folder").click()
    page.get_by_text("first is this run").wait_for()
    page.get_by_role("button", name="Add a recording").click()
    row(page, "walk.mp4").click()
    page.locator("#command", has_text="gsba add first walk.mp4").wait_for()
    page.get_by_role("button", name="Start").click()
    page.get_by_role("heading", name="add first").wait_for()
    status(page, "failed")
    page.get_by_text("first has recording").first.wait_for()  # its only one, once more
    page.goto(done)
    page.get_by_role("button", name="Nerfstudio", exact=True).click()
    page.get_by_role("heading", name="export first").wait_for()
    status(page, "done")
    assert (server.root / "first/nerfstudio/transforms.json").is_file()
    # The line that was shown gives the same bytes in a terminal.
    assert line is not None and line.startswith("gsba refine walk.mp4 ")
    words = [word.replace("first", "second") for word in line.split()[1:]]
    subprocess.run([*GSBA, *words], cwd=server.root, check=True, capture_output=True)
    ours, other = (server.root / name / "trajectory.tum" for name in ("first", "second"))
    assert ours.read_bytes() == other.read_bytes()
    page.goto(f"{server.address}#compare")
    for name in ("first", "second"):
        row(page, name).click()
        page.get_by_role("button", name="Take this folder").click()
        page.get_by_role("columnheader", name=name).wait_for()
    assert fits(page)
    page.locator(".files .shot img").nth(2).wait_for()
    picture(page, "app-compare")
    page.get_by_role("button", name="Plot them side by side").click()
    page.get_by_role("heading", name="plot compared/first-second").wait_for()
    status(page, "done")
    figures_are_drawn(page)
    assert fits(page)
    assert [fault for fault in page.faults if not fault.endswith("failed")] == []


def test_from_a_dropped_file_to_a_dataset_in_six_clicks(
    browser: Any, server: Server, tmp_path: Path
) -> None:
    (tmp_path / "root").mkdir()
    empty = Server(tmp_path / "root", tmp_path / "state")
    try:
        page = browser.new_page(viewport=DESK)
        page.set_default_timeout(RUN_MS)
        page.add_init_script(COUNT_CLICKS)
        page.goto(empty.address)
        page.get_by_text("Nothing is here yet").wait_for()
        film = (server.root / "walk.mp4").read_bytes()
        dropped(page, "walk.mp4", film)
        page.get_by_text("walk.mp4 has arrived", exact=True).first.wait_for(state="attached")
        assert (empty.root / "walk.mp4").read_bytes() == film
        row(page, "walk.mp4").click()
        page.get_by_text("Fast", exact=True).click()
        page.get_by_role("button", name="Start").click()
        status(page, "done")
        page.get_by_role("button", name="Nerfstudio", exact=True).click()
        page.get_by_role("heading", name="export walk-run").wait_for()
        status(page, "done")
        assert (empty.root / "walk-run/nerfstudio/transforms.json").is_file()
        page.get_by_text("ns-train splatfacto").wait_for()  # how the trainer is started
        assert page.evaluate("window.clicks") <= 6
        page.get_by_role("link", name="Back to walk-run").click()
        looked = page.locator("canvas.panorama[data-shown*='frame=0']")
        looked.wait_for()
        before = looked.screenshot()
        looked.focus()
        page.keyboard.press("ArrowRight")
        assert looked.screenshot() != before
    finally:
        empty.kill()


def test_a_drop_goes_on_after_a_closed_page_and_a_killed_server(
    browser: Any, server: Server
) -> None:
    size, folder = 20 * 2**20, server.root
    page = browser.new_page(viewport=PHONE)
    page.goto(server.address)
    row(page, "walk.mp4").wait_for()
    held: list[Any] = []

    def hold_the_second(route: Any) -> None:
        held.append(route)
        if len(held) != 2:
            route.continue_()

    page.route("**/upload?*", hold_the_second)
    with page.expect_request(lambda r: "upload" in r.url and "offset=8388608" in r.url):
        dropped(page, "big.mp4", size)
    page.close(run_before_unload=False)
    assert not (folder / "big.mp4").exists()
    page = browser.new_page(viewport=PHONE)
    page.goto(server.address)
    page.get_by_text("has arrived to 40 % of 21 MB").wait_for()
    assert fits(page)
    held.clear()
    page.route("**/upload?*", hold_the_second)
    with page.expect_request(lambda r: "upload" in r.url and "offset=16777216" in r.url):
        dropped(page, "big.mp4", size)
    while len(held) < 2:
        page.wait_for_timeout(20)
    server.kill()
    held[1].abort()
    server.start()
    page.locator("#drops").get_by_text("big.mp4 has arrived").wait_for()
    assert (folder / "big.mp4").stat().st_size == size
    dropped(page, "big.mp4", size)
    page.locator("#drops").get_by_text("big.mp4 is here already").wait_for()
    dropped(page, "big.mp4", 1000)
    page.locator("#drops").get_by_text("Another big.mp4 is here: this one becomes").wait_for()
    dropped(page, "notes.docx", b"words")
    page.locator("#drops").get_by_text("notes.docx is no footage").wait_for()
    row(page, "big-2.mp4").wait_for()
    assert fits(page)
    for name in ("big.mp4", "big-2.mp4"):
        (folder / name).unlink()


def test_all_that_can_be_used_has_a_name(browser: Any, server: Server) -> None:
    """Buttons, links, fields and pictures have names; rows answer the keyboard."""
    page = opened(browser, server.address, DESK)
    row(page, "walk.mp4").focus()
    page.keyboard.press("Enter")
    page.get_by_text("Drag to look around.").wait_for()
    page.get_by_text("Options:").click()
    nameless = page.evaluate(NAMELESS)
    assert nameless == []
    assert page.evaluate("document.querySelectorAll('h1').length") == 1
    assert page.faults == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_fault(browser: Any, server: Server, scheme: str) -> None:
    """Lists, a start with its options, the queue, a run and its report, on a desk and a phone."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    folder, found = server.root / "seen", list[str]()
    if not (folder / "report.html").exists():
        line = ("refine", "walk.mp4", "--out", "seen", "--config", "fast")
        subprocess.run([*GSBA, *line], cwd=server.root, check=True, capture_output=True)
    ready = {
        f"{server.address}#files": "refined",
        f"{server.address}#start/walk.mp4": "Drag to look around.",
        f"{server.address}#jobs": "One job runs at a time.",
        f"{server.address}#run/seen": "Dataset for your trainer",
        f"{server.address}#compare/seen": "Figures",
        folder.joinpath("report.html").as_uri(): "Share of time",
    }
    for address, text in ready.items():
        page = browser.new_page(viewport=DESK, color_scheme=scheme)
        page.set_default_timeout(RUN_MS)
        page.goto(address)
        page.get_by_text(text).first.wait_for(state="attached")
        for each in page.locator("details").all():
            each.evaluate("(one) => { one.open = true; }")
        for size in (DESK, PHONE):
            page.set_viewport_size(size)
            faults = axe.run(page).response["violations"]
            found += [f"{address} {one['id']}: {one['nodes'][0]['html']}" for one in faults]
        page.close()
    assert found == []


def held(server: Server, run: str) -> int:
    """Process group of a running job, paused: it must not be done before it is stopped."""
    (job,) = (
        path.parent
        for path in server.state.glob("jobs/*/job.json")
        if json.loads(path.read_text())["run"] == run
    )
    group = json.loads((job / "state.json").read_text())["pid"]
    os.killpg(group, signal.SIGSTOP)
    return group


def test_a_run_is_stopped_and_goes_on_and_the_next_one_waits(browser: Any, server: Server) -> None:
    page = opened(browser, server.address, PHONE)
    chosen(page, "third")
    page.get_by_role("button", name="Start").click()
    status(page, "running")
    group = held(server, "third")
    page.goto(f"{server.address}#files")
    chosen(page, "fourth")
    page.get_by_role("button", name="Start").click()
    status(page, "waiting")
    page.goto(f"{server.address}#jobs")
    first = page.locator(".jobs li", has_text="refine third")
    next_one = page.locator(".jobs li", has_text="refine fourth")
    next_one.get_by_role("button", name="Take out").click()
    next_one.locator(".badge.stopped").wait_for()
    with page.expect_response("**/stop"):
        first.get_by_role("button", name="Stop").click()
    os.killpg(group, signal.SIGCONT)
    first.locator(".badge.stopped").wait_for()
    assert fits(page)
    first.get_by_role("button", name="Go on").click()
    first.locator(".badge.done").wait_for()
    assert (server.root / "third/report.html").is_file()
    next_one.get_by_role("button", name="Forget").click()
    next_one.wait_for(state="detached")
    assert page.faults == []


def test_the_command_is_of_the_newest_values_though_an_older_answer_comes_last(
    browser: Any, server: Server
) -> None:
    page = opened(browser, server.address, DESK)
    held: list[Any] = []

    def hold_the_first(route: Any) -> None:
        held.append(route)
        if len(held) > 1:
            route.continue_()

    page.route("**/api/command", hold_the_first)
    chosen(page, "later")
    with page.expect_response("**/api/command"):
        held[0].continue_()
    page.wait_for_timeout(100)
    assert "--out later" in page.locator("#command").text_content()


def test_a_dataset_is_of_the_chosen_map_and_goes_without_frames_in_doubt(
    browser: Any, server: Server
) -> None:
    """The buttons of trainers ask for what is chosen above them."""
    summary = {"frames": 9, "refined": 5, "exported": 5, "points": 50, "maps": 2, "seconds": 3.0}
    summary |= {"median_residual_deg": 0.01, "median_residual_deg_coarse": 0.1}
    reason = {"line": "000003: hardly any matches", "leave_out": True, "frames": ["000003"]}
    verdict = {"level": "look at these places", "sentence": "some", "reasons": [reason]}
    report = {"summary": summary, "verdict": verdict, "maps": [{"frames": 5}, {"frames": 3}]}
    (server.root / "doubted").mkdir()
    (server.root / "doubted/report.json").write_text(json.dumps(report))
    page = opened(browser, f"{server.address}#run/doubted", DESK)
    asked: list[Any] = []

    def refused(route: Any) -> None:
        asked.append(route.request.post_data_json["values"])
        route.fulfill(status=400, json={"error": f"{len(asked)} heard"})

    page.route("**/api/add", refused)
    box, maps = page.get_by_label("Leave out frames in doubt"), page.locator("#map-number")
    acts = (lambda: None, box.uncheck, lambda: maps.select_option("2: 3 frames"))
    trainer, titles = page.get_by_role("button", name="Postshot"), []
    for number, act in enumerate(acts, start=1):
        act()
        titles.append(trainer.get_attribute("title"))
        trainer.click()
        page.get_by_text(f"{number} heard").wait_for()
    plain = {"run": "doubted", "to": "postshot", "up": "auto"}
    assert asked == [plain | {"without": ["doubted"]}, plain, plain | {"map_number": "2"}]
    line = "gsba export doubted --to postshot --up auto"
    assert titles == [f"{line} --without doubted", line, f"{line} --map 2"]
    assert fits(page)


def test_what_cannot_be_refined_is_said_in_one_line(browser: Any, server: Server) -> None:
    (server.root / "broken.mp4").write_bytes(b"no video")
    page = opened(browser, server.address, PHONE)
    row(page, "broken.mp4").click()
    alert = page.get_by_role("alert").filter(has_text="broken.mp4")
    alert.wait_for()
    assert page.locator("#command").count() == 0
    other = opened(browser, server.address.replace(server.address.split("/")[3], "guess"), PHONE)
    assert "Forbidden" in (other.text_content("body") or "")


def test_a_page_in_the_dark_has_contrast(browser: Any, server: Server) -> None:
    page = browser.new_page(viewport=DESK, color_scheme="dark")
    page.goto(server.address)
    page.get_by_role("heading", name="Footage and runs").wait_for()
    back, text = page.evaluate(
        "[getComputedStyle(document.body).backgroundColor, getComputedStyle(document.body).color]"
    )
    shades = [sum(map(int, re.findall(r"\d+", color)[:3])) / 3 for color in (back, text)]
    assert shades[0] < 60 and shades[1] > 200
