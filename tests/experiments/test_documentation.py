"""Generated parts of the documentation: public names have their places, tables come from the program, pictures from motions."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import torchmbd as mbd
from experiments.documentation import generated, recorded, reference, validation
from experiments.documentation.animated_svg import animated_svg, drawing
from experiments.paper.part import Finding, Part, Row
from torchmbd.api import all_names

DOCS = Path(__file__).parents[2] / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def _named(page: Path) -> str:
    return str(page.relative_to(DOCS))


def test_every_public_name_stands_in_the_reference_once():
    names = [name for group in reference.GROUPS.values() for name in group.split()]
    assert sorted(names) == sorted(all_names())
    pages = "".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    for group in reference.GROUPS:
        assert pages.count(f"<!-- generated: group {group} -->") == 1, group
    pages = "".join(mark["text"] for mark in generated.MARK.finditer(pages) if mark["part"] == "group")
    for name in names:
        assert len(re.findall(rf"^### {re.escape(name)}$", pages, re.MULTILINE)) == 1, name


@pytest.mark.parametrize("page", [p for p in PAGES if generated.MARK.search(p.read_text(encoding="utf-8"))], ids=_named)
def test_generated_parts_are_current_and_the_same_on_every_machine(page):
    text = page.read_text(encoding="utf-8")
    assert text == generated.renewed(text), "run python -m experiments.documentation.generated"
    parts = [mark["text"] for mark in generated.MARK.finditer(text)]
    assert all(parts)
    for trace in (str(DOCS.parent), str(Path.home()), " at 0x", tempfile.gettempdir() + "/"):
        assert not any(trace in part for part in parts), trace


def test_no_page_asks_for_a_part_that_does_not_exist():
    for page in PAGES:
        parts = re.findall(r"<!-- (?:generated|insert): (\w+)", page.read_text(encoding="utf-8"))
        assert set(parts) <= set(generated.PARTS), page.name
        assert len(parts) == len(generated.MARK.findall(page.read_text(encoding="utf-8"))), page.name


def test_an_entry_has_signature_text_columns_example_and_methods():
    text = reference.group("materials")
    laminate = text[text.index("### Laminate\n") : text.index("### fibers.SteeredLaminate\n")]
    assert "```python\nLaminate(\n    ply: Lamina | Sequence[Lamina],\n" in laminate
    assert "```text\n" in laminate
    assert "```pycon\n>>> laminate = mbd.Laminate(" in laminate
    assert "#### Laminate.stiffness\n" in laminate
    assert "#### Laminate.total_thickness\n\n```python\nLaminate.total_thickness: " in laminate
    assert "_integrals" not in laminate


def test_signatures_are_those_of_the_source():
    def law(t: float, /, speed: float = 1.0, *, table: Callable[[], float] = lambda: 0.0, **others: int) -> list[float]:
        """A number at a time [s]: a * b, if 0 < b, as `a[0] * b`."""
        return [t, speed, table(), *others.values()]

    text = reference._entry("law", law, 3)
    assert (
        "law(t: float, /, speed: float = 1.0, *, table: Callable[[], float] = ..., **others: int) -> list[float]"
        in text
    )
    assert "&#91;s]: a &#42; b, if 0 &lt; b, as `a[0] * b`" in text


def test_commands_and_keys_are_those_of_the_program():
    commands = reference.commands()
    for word in ("## torchmbd run", "--scheduler", "## torchmbd sync"):
        assert word in commands
    assert "\ntorchmbd run [OPTIONS] FILE" in commands  # whatever program makes the page
    keys = reference.file_keys()
    for word in (
        "| `model` |",
        "| `spectral_radius` |",
        "`trust-constr`",
        "| `ply_failure` |",
        "| `duration` | Simulated time &#91;s]. | number > 0 | required |",
        "| `at_most` |",
    ):
        assert word in keys
    assert "[" not in keys.replace("`[]`", "")  # mkdocs takes a unit in brackets for a link
    files = [path for path in (DOCS.parent / "configs").rglob("*.yaml") if path.parent.name != "configs"]
    assert reference.experiments().count("\n| `configs/") == len(files)
    assert reference.first_file().startswith("```yaml\n# ")


def test_rows_of_the_paper_become_tables():
    part = Part("table9", "Table 9: a title", lambda folder: [], (), 1.0)
    rows = [Row("energy (J)", 2.0, 2.1, "given", "a | b"), Row("angles (deg)", None, "0/90", "chosen")]
    page = validation.page([Finding(part, rows, [], 3.0, False)])
    assert "| energy (J) | 2 | 2.1 | 1.050 | given | a \\| b |\n| angles (deg) |  | 0/90 |  | chosen |  |" in page
    assert "`python -m experiments.paper table9`, 3 s" in page


def test_outputs_of_commands_become_blocks_of_a_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "# A\n\n<!-- recorded: paper.gradients -->\n<!-- end -->\n\n"
        "<!-- recorded: paper.table3 --starts 2 -->\nold\n<!-- end -->\n"
    )
    recorded.record(page, "paper.table3 --starts 2", lambda command: "a   \n\n b\n\n")
    text = page.read_text()
    assert recorded.commands(page)["paper.gradients"] == ""
    assert "`python -m experiments.paper.table3 --starts 2`, 20" in text
    assert "```text\na\n\n b\n```\n<!-- end -->\n" in text
    assert "old" not in text


def test_a_command_that_fails_does_not_keep_the_others_from_their_pages(monkeypatch, tmp_path, capsys):
    for name in ("first", "second"):
        (tmp_path / f"{name}.md").write_text(f"<!-- recorded: {name} -->\nold\n<!-- end -->\n")

    def output(command):
        if command == "first":
            raise subprocess.CalledProcessError(3, command)
        return "new"

    monkeypatch.setattr(validation, "FOLDER", tmp_path)
    monkeypatch.setattr(validation, "ELSEWHERE", ())
    monkeypatch.setattr(recorded, "run", output)
    monkeypatch.setattr("sys.argv", ["validation"])
    assert validation.main() == 1
    assert "old" in (tmp_path / "first.md").read_text()
    assert "new" in (tmp_path / "second.md").read_text()
    assert "Command 'first' returned non-zero exit status 3" in capsys.readouterr().err


PAGES = [*sorted((DOCS / "validation").glob("*.md")), *validation.ELSEWHERE]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_recorded_commands_exist_and_have_an_output(page):
    for command, text in recorded.commands(page).items():
        assert importlib.util.find_spec(recorded.module(command)) is not None, command
        assert re.match(r"`python -m .+`, \d{4}-\d\d-\d\d, \d+ s, .+ cores, torch .+\n\n```text\n", text), command


@pytest.mark.filterwarnings("ignore")
def test_a_picture_shows_the_motion(tmp_path):
    arm = mbd.RigidBody("arm", 1.0, (0.01, 0.01, 0.01), position=(0.5, 0, 0))
    hinge = mbd.Revolute(mbd.Ground().at(), arm.at(-0.5, 0, 0), axis="z")
    drive = mbd.Drive(mbd.Ground(), arm, axis="z", speed=2.0)
    motion = mbd.simulate(mbd.System([arm], [hinge, drive]), 1.0, steps=20, gradients="none")
    lines = drawing(motion, frames=5, along={"arm": [(-0.5, 0, 0), (0.5, 0, 0)]})
    angle = 2.0 * np.linspace(0.0, 1.0, 5)
    np.testing.assert_allclose(lines[0].points[:, 1], np.stack([np.cos(angle), np.sin(angle)], -1), atol=1e-6)
    file = animated_svg([("an arm", lines), ("again", lines)], tmp_path / "arm.svg")
    tags = [element.tag.rpartition("}")[2] for element in ElementTree.parse(file).iter()]
    assert tags.count("animate") == 2
    assert tags.count("text") == 6  # two titles; rigid, fixed, the length of the bar, words


def test_a_picture_of_a_flexible_body_says_lengths_time_and_scale(tmp_path):
    motion = mbd.simulate(mbd.examples.arm(), 0.05, steps=10, gradients="none")
    still, large = (drawing(motion, frames=3, view="xz", scale=scale)[0].points for scale in (1.0, 5.0))
    assert still.shape == large.shape
    assert np.abs(large - still).max() > 0
    file = animated_svg([("", drawing(motion, 3))], tmp_path / "arm.svg", duration=0.05, scale=5.0)
    texts = [element.text for element in ElementTree.parse(file).iter() if element.tag.endswith("text")]
    assert texts == ["flexible", "rigid", "fixed", "0.05 m", "0.05 s, deflections × 5"]
