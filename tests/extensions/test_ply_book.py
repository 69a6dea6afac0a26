"""Ply books: every ply of every zone, from the bottom, in degrees and millimeters."""

from __future__ import annotations

import csv
import xml.etree.ElementTree as ET

import torchmbd as mbd
from tests.refused import refused, warned
from torchmbd.fem.elements import Plates

CARBON = mbd.examples.carbon()
STEEL = mbd.Ply.isotropic(210e9, 0.3, 7850.0)


def two_zones() -> mbd.FlexibleBody:
    """A symmetric stack of two materials, and an offset one."""
    mesh = mbd.mesh.rectangle(0.3, 0.1, (2, 1), "quad")
    inner = mbd.Laminate([CARBON, STEEL], mbd.deg([22.5, 0.0]), [1e-3, 2e-3], symmetric=True)
    outer = mbd.Laminate(CARBON, mbd.deg([-60.0]), 0.25e-3, offset=1e-3)
    parts = {"inner": Plates(mesh, inner, cells=[0]), "outer<&": Plates(mesh, outer, cells=[1])}
    return mbd.FlexibleBody("panel", mesh, parts, 2, reference="left_edge")


def test_a_table_has_all_plies_from_the_bottom(tmp_path):
    with mbd.io.write_ply_book(two_zones(), tmp_path / "book.csv").open() as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["body", "zone", "ply", "angle [deg]", "thickness [mm]", "material", "bottom [mm]"]
    assert rows[1:] == [
        ["panel", "inner", "1", "22.5", "1", "M1", "-3"],
        ["panel", "inner", "2", "0", "2", "M2", "-2"],
        ["panel", "inner", "3", "0", "2", "M2", "0"],
        ["panel", "inner", "4", "22.5", "1", "M1", "2"],
        ["panel", "outer<&", "1", "-60", "0.25", "M1", "0.875"],
    ]


def test_a_page_has_tables_and_sketches(tmp_path):
    """The page is well-formed, the top ply is the first row, and each ply has its hatching."""
    text = mbd.io.write_ply_book(two_zones(), tmp_path / "book.html").read_text()
    page = ET.fromstring(text.replace("<!DOCTYPE html>", "").replace("<meta charset='utf-8'>", ""))
    materials, inner, outer = page.findall(".//table")
    assert [row[1].text for row in materials.findall("tr")][1:] == [f"{x / 1e9:.6g}" for x in (CARBON.E1, 210e9)]
    assert [row[0].text for row in inner.findall("tr")][1:] == ["4", "3", "2", "1"]
    assert outer.findall("tr")[1][1].text == "-60"
    assert [len(sketch.findall("rect")) for sketch in page.findall(".//svg")] == [4, 1]
    assert page.findall(".//h2")[1].text == "panel / outer<&"


def test_bad_input_is_refused(tmp_path):
    with refused("path"):
        mbd.io.write_ply_book(two_zones(), tmp_path / "book.pdf")
    section = mbd.sections.tube(0.02, CARBON, [0.0], thickness=1e-3, cells=(8, 1))
    body, rod = two_zones(), mbd.FlexibleBody.beam("rod", mbd.BeamLine.straight(1.0, 2), section, 2)
    with warned("body 'rod'", "laminated shells"):
        mbd.io.write_ply_book(mbd.System([body, rod], free=["panel", "rod"]), tmp_path / "book.csv")
