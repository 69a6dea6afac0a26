"""Every shipped experiment file is read, built and run for two iterations, on a coarse rod and a short time."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import pytest
from rich.console import Console

from torchmbd.study.file.config_index import QUESTION_MISSING, configs
from torchmbd.study.file.load import STUDY, load, load_study
from torchmbd.study.file.yaml_file import read_yaml
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.usefixtures("compiled")

CONFIGS = configs(Path(__file__).parents[2] / "configs")
DATA = {file: read_yaml(file).data for file in CONFIGS}
# Phases and windows need all their time: those files have tests of their own, test_sar_antenna_whole.py and so on;
# those that fit a model to measurements: tests/extensions/identification/test_files.py; fronts: tests/study/test_study.py.
STUDIES = [
    file
    for file, data in DATA.items()
    if not data.keys() & {"figures", "identify", "tradeoff"}
    and "phases" not in data["simulate"]
    and file.parent.name != "spatial_arm"
]
# Of the studies of one, two and three layers by four measures: every count of layers and every measure; the others are slow.
COVERING = {"l1_energy_peak", "l2_energy_bound", "l3_energy_integral", "l1_energy_torsion", "l2_energy_tolerance"}
# The panels of the antenna have their joints on nodes of 16 x 8 cells. Of the blade's motion nothing is asked.
COARSE = {
    "slider_crank": ["simulate.duration=0.004", "simulate.steps=40", "options.modes=4", "options.cells=[4, 2]"],
    "sar_antenna": ["simulate.duration=0.004", "simulate.steps=4", "options.modes=4", "options.cells=[16, 8]"],
    "turning_blade": ["options.elements=3"],
}


@pytest.fixture(scope="module")
def uri(tmp_path_factory, empty_store):
    return f"sqlite:///{shutil.copy(empty_store, tmp_path_factory.mktemp('store'))}"


def test_there_are_configs():
    assert {file.stem for file in CONFIGS} >= {
        # Tables 3-5
        *(f"l{layers}_energy_{what}" for layers in (1, 2, 3) for what in ("integral", "peak", "bound", "torsion")),
        "l2_energy_tolerance",
        "l1_angle_sweep",
        "l1_torsion_sweep",
        "figures4_7",
        "figures8_11",
        "energy_integral",  # Tables 7, 8
        "alignment",  # section 6.1
        "swing",  # a drive's numbers as design variables, phases
    }


def files() -> list:
    of_extensions = {file for file, data in DATA.items() if "identify" in data}
    return [pytest.param(x, id=x.stem, marks=[pytest.mark.extensions] if x in of_extensions else []) for x in CONFIGS]


@pytest.mark.parametrize("file", files())
def test_every_config_opens_with_its_question_and_is_valid(file):
    question = CONFIGS[file]
    assert question != QUESTION_MISSING
    assert "?" in question
    kind, plan = load(file)
    data = plan.origin.data if kind is STUDY else plan.data
    assert type(data).model_validate(data.resolved()).resolved() == data.resolved()


def studies() -> list:
    tables = [file for file in STUDIES if file.stem[:3] in ("l1_", "l2_", "l3_") and "_energy_" in file.stem]
    slow = {file for file in tables if file.stem not in COVERING}
    return [pytest.param(x, id=x.stem, marks=[pytest.mark.slow] if x in slow else []) for x in STUDIES]


@pytest.mark.thorough(
    "energy_integral",
    "multistart",
    "l1_energy_peak",
    "l2_energy_bound",
    "l2_energy_tolerance",
    "trusses",
    "l1_energy_torsion",
    "l3_energy_integral",
)
@pytest.mark.parametrize("file", studies())
def test_every_study_runs(file, uri):
    overrides = list(COARSE[file.parent.name])
    if load_study(file).sweep is None:
        overrides += ["optimizer.max_iterations=2", "starts.count=2"]
    else:
        overrides += ["sweep.rod.laminate.angles.count=5"]
    plan = load_study(file, overrides)
    tracker = MlflowTracker(file.stem, uri)
    output = io.StringIO()
    assert run_study(plan, Console(file=output), tracker) in (0, UNVERIFIED)
    runs = open_store(tracker.uri).search_runs([tracker.record.experiment_id])
    assert {run.info.status for run in runs} == {"FINISHED"}
    (parent,) = [run for run in runs if run.data.tags["kind"] in ("study", "sweep")]
    assert len(runs) - 1 == (5 if plan.sweep else 2)
    assert parent.data.metrics["search/failed_evaluations"] == 0
    assert parent.data.metrics["reduction_percent"] > 0  # the start designs are far from the best
