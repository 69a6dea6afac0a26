"""Keys: what changes a number changes the key of the problem, what changes the iteration changes the key of the study."""

from __future__ import annotations

import io
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy
import torch
import torchdiffeq
from rich.console import Console

from tests.extensions.nastran.bdf_models import model as bdf_model
from tests.study.silent_tracker import Silent
from torchmbd.fem.mesh import rectangle
from torchmbd.study.file.load import load_study
from torchmbd.study.record import paths as paths_module
from torchmbd.study.record.paths import evaluations_file, problem_key, studies_folder
from torchmbd.study.run import run_study


def keys(file, *overrides):
    plan = load_study(file, overrides)
    return problem_key(plan.simulated), plan.key("sqlite:///runs.db")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("override", "problem", "study"),
    [
        ("optimizer.max_iterations=9", False, True),
        ("starts.seed=8", False, True),
        ("design.rod.laminate.angles.upper=80", False, True),
        ("tracking.experiment=other", False, True),
        ("design.rod.laminate.angles.start=[40, -45]", True, True),
        ("simulate.steps=61", True, True),
        ("options.layers=2", False, False),  # as in the file
        ("subject_to.0.at_most=1.5", True, True),
        ("minimize={max: {strain_energy: rod}}", True, True),
    ],
)
def test_which_keys_change(write, override, problem, study):
    before = keys(write())
    after = keys(write(), override)
    assert (before[0] != after[0], before[1] != after[1]) == (problem, study)


@pytest.mark.thorough
def test_another_model_in_the_same_file_is_another_problem(write, folder):
    before = keys(write())
    model = folder / "rod_model.py"
    model.write_text(model.read_text().replace("modes=4", "modes=3"))
    after = keys(write())
    assert before[0] != after[0]
    assert before[1] != after[1]


MODEL = """
from pathlib import Path
import numpy as np
import torchmbd as mbd
from masses import crank
HERE = Path(__file__).parent
def build(layers: int = 2) -> mbd.System:
    ply = mbd.Ply(E1=128e9, E2=10.1e9, G12=5.36e9, G13=5.36e9, G23=5.36e9, nu12=0.23, density=1586.0)
    laminate = mbd.Laminate(ply, angles=mbd.deg([45.0, -45.0]), thickness=7.5e-3 / layers)
    mesh = HERE / "rod.inp"
    rod = mbd.io.read_mesh(mesh, "rod", laminate, 2, reference="left", axes=[[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    plate = mbd.io.read_bdf(HERE / "plate.bdf", "plate", 1)
    ground = mbd.Ground()
    push = float(np.loadtxt(HERE / "push.txt"))
    joints = [mbd.Fixed(ground.at(), rod.at("left")), mbd.Fixed(rod.at("right"), plate.at(0))]
    return mbd.System([rod, plate], joints, [mbd.Force(plate.at(5), (0, 0, crank() * push))])
"""


@pytest.fixture
def study(write, folder):
    """A model that reads a mesh, a BDF file, a table of numbers and a module, all beside it."""
    import meshio

    mesh = rectangle(length=0.3, width=0.04, cells=(4, 2))
    sets = {name: torch.tensor(mesh.node_set(f"{name}_edge")).numpy() for name in ("left", "right")}
    points, cells = mesh.nodes.numpy(), [("quad", mesh.quads.numpy())]
    meshio.Mesh(points, cells, point_sets=sets).write(folder / "rod.inp")
    (folder / "plate.bdf").write_text(bdf_model((2, 1)))
    (folder / "push.txt").write_text("10.0\n")
    (folder / "masses.py").write_text("def crank():\n    return 2.0\n")
    (folder / "files.py").write_text(MODEL)
    brief = {"duration": 0.002, "steps": 4}
    design = {"rod.laminate.angles": {"lower": -90, "upper": 90, "unit": "deg"}}
    return write(model="files.py:build", simulate=brief, design=design, subject_to=None, starts=None)


def known(file: Path, tracker) -> tuple[int, str]:
    """How many evaluations a run has found in the store, and its table."""
    output = io.StringIO()
    run_study(load_study(file), Console(file=output, width=120), tracker)
    result = re.search(r"(\d+) of \d+ evaluations known", output.getvalue())
    return int(result[1]) if result else 0, re.findall(r"^ +0 +([\d.e-]+)", output.getvalue(), re.MULTILINE)[-1]


@pytest.mark.thorough
@pytest.mark.extensions
@pytest.mark.parametrize(
    ("name", "old", "new", "same"),
    [
        ("masses.py", "2.0", "3.0", False),
        ("push.txt", "10.0", "11.0", False),
        ("rod.inp", "7.4999999999999997e-02", "7.4e-02", False),
        ("plate.bdf", ",.23,", ",.24,", False),
        ("masses.py", "def", "# of the crank\n\ndef", True),
        ("files.py", "def", "# of the rod\n\ndef", True),
        ("plate.bdf", "ENDDATA", "$ a comment\nENDDATA", True),
    ],
)
def test_what_a_model_reads_counts_and_comments_do_not(study, folder, name, old, new, same):
    """One number elsewhere makes another problem; a comment leaves it."""
    before = problem_key(load_study(study).simulated)
    assert problem_key(load_study(study).simulated) == before
    replace(folder / name, old, new)
    assert (problem_key(load_study(study).simulated) == before) is same


@pytest.mark.extensions
@pytest.mark.thorough
def test_evaluations_of_the_same_model_are_known(study, folder, monkeypatch):
    """Those of a file with one more comment, but none of a file with another number, whose table is another."""
    monkeypatch.setenv("TORCHMBD_STORE", str(folder / "store"))
    first = known(study, Silent())
    assert first[0] == 0
    replace(folder / "masses.py", "def", "# of the crank\n\ndef")
    second = known(study, Silent())
    assert second[0] > 0
    assert second[1] == first[1]
    replace(folder / "masses.py", "2.0", "3.0")
    third = known(study, Silent())
    assert third[0] == 0
    assert third[1] != first[1]


def replace(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


PARTS = sorted(p.name for p in paths_module._PACKAGE.iterdir() if p.is_dir() and p.name != "__pycache__")


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A copy of the package's sources."""
    package = tmp_path_factory.mktemp("copied") / "torchmbd"
    shutil.copytree(paths_module._PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    return package


SEARCHES = [f"optimization/{part}" for part in ("methods", "multistart", "discrete")]


@pytest.mark.parametrize("part", [*PARTS, *SEARCHES, "errors.py", "cli.py", "extensions/native/steps.cpp"])
def test_the_sources_that_compute_numbers_count(copied, monkeypatch, part):
    """The searches, the tracking, the pictures and the command line see an evaluation when it is made.

    The searches choose the designs of a study, so they count in its key.
    """
    folder = copied / part
    shown = part in ("cli.py", "tracking", "viz")
    counts = {  # sources left out -> a part counts
        (*paths_module._SHOWN, *paths_module._SEARCHES): not shown and part not in ("study", *SEARCHES),
        paths_module._SHOWN: not shown,
    }
    for file in sorted(folder.glob("*.py"))[-2:] if folder.is_dir() else [folder]:
        text = file.read_text()
        for without, part_counts in counts.items():
            before = paths_module._code(paths_module._PACKAGE, without)
            for more, changed in (("", False), ("\nx = 1;\n", part_counts)):
                file.write_text(text + more)
                paths_module._code.cache_clear()
                assert (paths_module._code(copied, without) != before) is changed, file
            file.write_text(text)


@pytest.mark.thorough
def test_the_sources_count_in_both_keys(write, copied, monkeypatch):
    before = keys(write())
    file = copied / "design" / "measures.py"
    text = file.read_text()
    file.write_text(text + "\nx = 1\n")
    paths_module._code.cache_clear()
    monkeypatch.setattr(paths_module, "_PACKAGE", copied)
    after = keys(write())
    file.write_text(text)
    paths_module._code.cache_clear()
    assert before[0] != after[0]
    assert before[1] != after[1]


@pytest.mark.thorough
@pytest.mark.parametrize("package", [torch, np, scipy, torchdiffeq])
def test_another_version_of_what_computes_is_another_problem(write, monkeypatch, package):
    before = keys(write())
    monkeypatch.setattr(package, "__version__", "0.0.1")
    after = keys(write())
    assert before[0] != after[0]
    assert before[1] != after[1]


@pytest.mark.thorough
def test_an_evaluation_leaves_the_key_as_it_is(write):
    """What a system works out when it is first used is no change of it."""
    plan = load_study(write(), ["simulate.duration=0.001", "simulate.steps=4"])
    before = problem_key(plan.simulated)
    problem = plan.simulated
    problem.evaluate(problem.start[None], True)
    assert problem_key(plan.simulated) == before


def test_the_place_is_in_the_working_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("TORCHMBD_STORE")
    assert studies_folder() == tmp_path / ".torchmbd"
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "there"))
    assert evaluations_file() == tmp_path / "there" / "evaluations.db"
