"""The process that draws: the same figures as here, in the order of the orders, and no figure costs another."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from torchmbd import bare
from torchmbd.viz import design_map, energy_over_time, save
from torchmbd.viz.studio import FIGURES, Studio

ENERGIES = {"start design": np.array([0.0, 1.0, 0.5]), "best design": [0.0, 0.2, 0.1]}


@pytest.fixture(scope="module")
def studio():
    studio = Studio()
    studio.open()
    yield studio
    studio.close()


def pixels(file):
    return np.asarray(Image.open(file))


def test_figures_are_those_of_this_process(studio, tmp_path):
    path = np.array([[0.0, 0.0], [1.0, 2.0]])
    names = ("energy.png", "energy.pdf", "map.png")
    energy, pdf, drawn_map = (tmp_path / name for name in names)
    studio.draw("energy_over_time", [energy, pdf], t=np.linspace(0, 1, 3), energies=ENERGIES)
    visited = (np.zeros((0, 2)), np.zeros(0))
    studio.draw(
        "design_map",
        [drawn_map],
        paths={"a": path},
        objectives={"a": [2.0, np.nan]},
        headings=["x", "y"],
        visited=visited,
    )
    assert [drawn.files for drawn in studio.finish()] == [(energy, pdf), (drawn_map,)]
    assert pdf.read_bytes().startswith(b"%PDF")
    here = save(energy_over_time(np.linspace(0, 1, 3), ENERGIES), tmp_path / "here.png")
    np.testing.assert_array_equal(pixels(energy), pixels(here))
    here = save(design_map({"a": path}, {"a": np.array([2.0, np.nan])}, ["x", "y"], visited=visited), here)
    np.testing.assert_array_equal(pixels(drawn_map), pixels(here))


def test_what_cannot_be_drawn_says_why_and_costs_nothing_else(studio, tmp_path):
    studio.draw("convergence", [tmp_path / "none.png"], objectives={}, violations={})
    studio.draw("energy_over_time", [tmp_path / "no" / "folder.png"], t=[0.0, 1.0], energies={"a": [0.0, 1.0]})
    studio.draw("energy_over_time", [tmp_path / "energy.png"], t=[0.0, 1.0], energies={"a": [0.0, 1.0]})
    empty, nowhere, good = studio.finish()
    assert "objectives is empty" in (empty.trouble or "")
    assert "No such file" in (nowhere.trouble or "")
    assert empty.files == nowhere.files == ()
    assert good.files == (tmp_path / "energy.png",)


def test_a_process_that_dies_is_replaced(tmp_path):
    studio = Studio()
    studio.open()
    assert studio._process is not None
    os.kill(studio._process.pid, signal.SIGSTOP)  # the order comes before the death
    studio.draw("energy_over_time", [tmp_path / "a.png"], t=[0.0, 1.0], energies={"a": [0.0, 1.0]})
    os.kill(studio._process.pid, signal.SIGKILL)
    assert [drawn.trouble for drawn in studio.finish()] == ["the process that draws has died"]
    studio.draw("energy_over_time", [tmp_path / "a.png"], t=[0.0, 1.0], energies={"a": [0.0, 1.0]})
    assert [drawn.trouble for drawn in studio.finish()] == [None]
    studio.close()


def test_orders_that_nobody_waited_for_are_forgotten(studio, tmp_path):
    studio.draw("energy_over_time", [tmp_path / "a.png"], t=[0.0, 1.0], energies={"a": [0.0, 1.0]})
    studio.open()
    assert studio.finish() == []


def test_the_process_does_without_torch():
    code = "import sys; import torchmbd.viz.studio; print('torch' in sys.modules)"
    program = bare.command("torchmbd.viz.studio")
    program[3] = program[3].partition("code =")[0] + f"name = sys.argv[2]\nimportlib.import_module(name)\n{code}"
    assert subprocess.run(program, capture_output=True, text=True).stdout == "False\n"
    assert program[0] == sys.executable


def test_every_order_is_a_figure_of_the_package():
    import torchmbd.viz

    assert all(getattr(torchmbd.viz, name) is figure for name, figure in FIGURES.items())
