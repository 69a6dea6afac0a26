"""The links that torchmbd prints, opened in a real browser on a real MLflow server: what they promise is on the page.

Needs Playwright and a Chromium, its own or the system's; skipped, by name, where they are missing.
"""

from __future__ import annotations

import shutil
import socket

import pytest

from torchmbd.tracking.catalog import find
from torchmbd.tracking.links import experiment_link, run_link, view_link
from torchmbd.tracking.server import serving

pytestmark = pytest.mark.browser
PATIENCE = 120_000  # milliseconds


@pytest.fixture(scope="module")
def page():
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    own = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=own, args=["--no-sandbox"])
        except sync_api.Error as error:
            pytest.skip(f"needs a Chromium: {str(error).splitlines()[0]}")
        page = browser.new_page(viewport={"width": 2400, "height": 1000})
        page.set_default_timeout(PATIENCE)
        yield page
        browser.close()


@pytest.fixture(scope="module")
def base(finished):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    with serving(finished.uri, port=port):
        yield f"http://127.0.0.1:{port}"


def test_the_table_shows_the_starts_with_objective_and_angles(page, base, finished):
    study = find(finished.uri, finished.runs[1])
    page.goto(view_link(base, study.experiment_id, study.run_id))
    page.get_by_text("start 1", exact=True).first.wait_for()
    text = page.inner_text("body")
    assert "2 matching runs" in text
    for word in ("start 0", "objective", "reduction_percent", "violation", "angle_1_deg", "angle_2_deg"):
        assert word in text
    children = finished.client.search_runs(
        [study.experiment_id], f"tags.mlflow.parentRunId = '{study.run_id}'", order_by=["metrics.objective ASC"]
    )
    for child in children:
        assert f"{child.data.metrics['design/angle_1_deg']}"[:7] in text
    assert text.index(children[0].info.run_name) < text.index(children[1].info.run_name)  # the best first


def test_the_charts_show_convergence(page, base, finished):
    study = find(finished.uri, finished.runs[1])
    page.goto(view_link(base, study.experiment_id, study.run_id, charts=True))
    page.get_by_text("start 1 (design/angle_1_deg)").first.wait_for()
    assert page.get_by_text("start 0 (design/angle_1_deg)").count()


def test_the_table_of_all_runs_opens(page, base, finished):
    study = find(finished.uri, finished.runs[1])
    page.goto(experiment_link(base, study.experiment_id))
    page.get_by_text("short", exact=True).first.wait_for()


def test_the_animation_plays_inside_the_page(page, base, finished):
    study = find(finished.uri, finished.runs[1])
    page.goto(run_link(base, study.experiment_id, study.run_id, "artifacts/motion_best.html"))
    frame = page.frame_locator("iframe")
    clock = frame.locator("#timeText")
    clock.wait_for()
    seen = {clock.inner_text()}
    for _ in range(200):
        page.wait_for_timeout(50)
        seen.add(clock.inner_text())
        if len(seen) > 3:
            break
    assert len(seen) > 3  # time goes on
    frame.locator("#play").click()
    assert frame.locator("#play").inner_text() == "play"
    stopped = clock.inner_text()
    page.wait_for_timeout(300)
    assert clock.inner_text() == stopped
    drawn = frame.locator("#view").evaluate(
        "c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size"
    )
    assert drawn > 20  # more than an empty canvas has
