"""The viewer on a phone: its controls leave the scene most of the screen."""

import shutil

import pytest
from tiny_run import Case

from gsba import view

pytest.importorskip("viser")
sync_api = pytest.importorskip("playwright.sync_api")

pytestmark = pytest.mark.slow


def test_the_panel_begins_folded(case: Case) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium here: apt-get install chromium")
    shown = view.serve(view.load_scene(case.out), 0)
    try:
        with sync_api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 390, "height": 844})
            page.goto(shown.address)
            heading = page.get_by_role("heading", name=case.out.name)
            heading.wait_for(timeout=60_000)
            assert heading.bounding_box()["y"] > 0.75 * 844
            assert not page.get_by_text("Stand inside").is_visible()
            page.get_by_text("Frame · Run").click()
            page.get_by_text("Stand inside").wait_for()
            browser.close()
    finally:
        shown.stop()
