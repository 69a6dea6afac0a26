"""Links of the built site are followed: a page, an anchor or a file that is missing is named."""

from __future__ import annotations

from experiments.documentation import links


def test_what_leads_nowhere_is_found(tmp_path):
    (tmp_path / "how").mkdir()
    (tmp_path / "arm.ipynb").write_text("{}")
    (tmp_path / "index.html").write_text(
        '<h1 id="top">A</h1><a href="how/units.html#mm">1</a><a href="how/">2</a><a href="#top">3</a>'
        '<a href="arm.ipynb">4</a><a href="https://example.org/x">5</a><img src="arm.svg">'
    )
    (tmp_path / "how" / "index.html").write_text('<a href="../index.html#none">6</a>')
    (tmp_path / "how" / "units.html").write_text(
        '<a name="mm"></a><a href="gone.html">7</a><a href="/index.html#top">8</a>'
    )
    pages = links.read(tmp_path)
    bad = {(link.page.name, link.target) for link in links.broken(pages, tmp_path)}
    assert bad == {("index.html", "arm.svg"), ("index.html", "../index.html#none"), ("units.html", "gone.html")}
    assert links.external(pages) == {"https://example.org/x": 1}
