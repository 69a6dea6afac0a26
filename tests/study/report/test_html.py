"""The report: one file, everything in it, nothing in it executed that is not ours."""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

from tests.refused import refused
from torchmbd.study.report.html import write_report
from torchmbd.tracking.catalog import children, find


class Tags(HTMLParser):
    """The tags of a page, in order, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.text += data


def test_the_report_shows_the_study(finished, tmp_path):
    path = write_report(finished.runs[0], tmp_path / "r.html", finished.uri)
    page = path.read_text()
    read = Tags(page)
    assert "What is the best lay-up of the test rod?" in read.text
    entry = find(finished.uri, finished.runs[0])
    for child in children(finished.uri, entry):
        assert f"{child.metrics['objective']:.6g}" in read.text
    assert f"{entry.metrics['reduction_percent']:.2f}" in read.text
    images = [attrs["src"] for tag, attrs in read.tags if tag == "img"]
    # Convergence, criteria over time and iterations, map of the design space, parallel coordinates.
    assert len(images) == 5
    assert all(base64.b64decode(src.partition(",")[2]).startswith(b"\x89PNG") for src in images)
    (frame,) = [attrs for tag, attrs in read.tags if tag == "iframe"]
    assert frame["sandbox"] == "allow-scripts"
    assert "const S = JSON.parse" in frame["srcdoc"]
    assert "model: rod_model.py:build" in read.text
    assert entry.tags["version.torch"] in read.text


def test_the_report_needs_no_network(finished, tmp_path):
    page = write_report("short", tmp_path / "r.html", finished.uri).read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)


def test_text_of_the_store_is_no_markup(finished, tmp_path):
    finished.client.set_tag(finished.runs[1], "mlflow.note.content", "<script>alert(1)</script>")
    entry = find(finished.uri, finished.runs[1])
    start, mark = children(finished.uri, entry)[0], "<b>from the store</b>"
    old = start.tags["status"]
    finished.client.set_tag(start.run_id, "status", mark)
    finished.client.update_run(start.run_id, name="<i>a start</i>")
    try:
        read = Tags(write_report(finished.runs[1], tmp_path / "r.html", finished.uri).read_text())
    finally:
        finished.client.set_tag(start.run_id, "status", old)
        finished.client.update_run(start.run_id, name=start.name)
    assert not {"script", "b", "i"} & {tag for tag, _ in read.tags}
    for text in ("<script>alert(1)</script>", mark, "<i>a start</i>"):
        assert text in read.text


def test_a_bad_name_is_refused(finished, tmp_path):
    with refused("output"):
        write_report("short", tmp_path / "r.txt", finished.uri)


def test_pages_of_vibrations_follow_the_motion(finished, tmp_path):
    artifacts = finished.folder / "mlartifacts" / finished.runs[1] / "artifacts"
    (artifacts / "mode_best_2.html").write_text("<p>a vibration</p>")
    read = Tags(write_report(finished.runs[1], tmp_path / "r.html", finished.uri).read_text())
    frames = [attrs["srcdoc"] for tag, attrs in read.tags if tag == "iframe"]
    assert len(frames) == 2
    assert "const S = JSON.parse" in frames[0]
    assert frames[1] == "<p>a vibration</p>"
    assert read.text.index("Motion of the best design") < read.text.index("A vibration of the best design")


def test_the_report_fits_a_telephone(finished, tmp_path):
    page = write_report("short", tmp_path / "r.html", finished.uri).read_text()
    assert '<meta name="viewport" content="width=device-width">' in page
    narrow = page[page.index("@media (max-width: 40rem)") : page.index("</style>")]
    assert "td { white-space: normal; }" in narrow  # responses wrap, so that their numbers are on the screen
