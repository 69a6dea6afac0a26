"""Studies and sweeps run for real, on a small rod, and read back from a real MLflow store."""

from __future__ import annotations

import io
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from rich.console import Console

from torchmbd.errors import SimulationFailure
from torchmbd.study.file.load import load_study as load
from torchmbd.study.run import UNVERIFIED, run_study
from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import open_store

pytestmark = pytest.mark.thorough

NAMED = ("constraint/max of strain energy of rod", "design/angle_1_deg", "design/angle_2_deg")
STUDY = yaml.safe_load(Path(__file__).with_name("study.yaml").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory, empty_store):
    """Run a variation of the test study; return exit code, output and what the store holds."""
    folder = tmp_path_factory.mktemp("runs")
    shutil.copy(Path(__file__).with_name("rod_model.py"), folder)
    uri = f"sqlite:///{shutil.copy(empty_store, folder)}"

    def run(name, raises=None, **sections):
        data = {key: value for key, value in (STUDY | sections).items() if value is not None}
        file = folder / f"{name}.yaml"
        file.write_text(yaml.safe_dump(data, sort_keys=False))
        output = io.StringIO()
        arguments = load(file), Console(file=output, width=100), MlflowTracker(name, uri)
        if raises:
            with pytest.raises(raises):
                run_study(*arguments)
            code = None
        else:
            code = run_study(*arguments)
        client = open_store(uri)
        runs = client.search_runs([client.get_experiment_by_name(name).experiment_id])
        children = [r for r in runs if "mlflow.parentRunId" in r.data.tags]
        (parent,) = [r for r in runs if r not in children]
        children.sort(key=lambda r: int(r.data.params.get("start", r.data.params.get("point"))))
        return SimpleNamespace(
            code=code, output=output.getvalue(), client=client, parent=parent, children=children, folder=folder
        )

    return run


@pytest.fixture(scope="module")
def study(run):
    return run("study")


@pytest.fixture(scope="module")
def sweep(run):
    return run(
        "sweep", optimizer=None, starts=None, sweep={"rod.laminate.angles[1]": {"from": -90, "to": 90, "count": 5}}
    )


def files(outcome):
    root = outcome.folder / "mlartifacts" / outcome.parent.info.run_id / "artifacts"
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


def test_a_study_ends_well(study):
    assert study.code == UNVERIFIED  # four cells leave more than a tenth of the gain
    assert study.parent.info.status == "FINISHED"
    assert [child.info.status for child in study.children] == ["FINISHED"] * 2
    assert {child.data.tags["mlflow.parentRunId"] for child in study.children} == {study.parent.info.run_id}


def test_every_iterate_is_a_step_of_its_start(study):
    for child in study.children:
        points = {
            key: {p.step: p.value for p in study.client.get_metric_history(child.info.run_id, key)}
            for key in (*NAMED, "objective", "violation", "search/analyses")
        }
        steps = list(range(int(child.data.metrics["search/iterations"]) + 1))
        assert all(sorted(history) == steps for history in points.values()), points
        assert points["objective"][steps[-1]] <= points["objective"][0]
        start = [float(child.data.params[f"start_angle_{k}_deg"]) for k in (1, 2)]
        assert start == pytest.approx([points["design/angle_1_deg"][0], points["design/angle_2_deg"][0]], rel=1e-5)


def test_the_first_start_is_the_design_of_the_file(study):
    params = study.children[0].data.params
    assert (params["start_angle_1_deg"], params["start_angle_2_deg"]) == ("45", "-45")


def test_the_parent_sums_the_study_up(study):
    metrics, tags = study.parent.data.metrics, study.parent.data.tags
    objectives = [child.data.metrics["objective"] for child in study.children]
    assert metrics["objective"] == metrics["best_objective"] == min(objectives)
    assert tags["best_start"] == str(int(np.argmin(objectives)))
    assert [child.data.tags["best"] for child in study.children].count("true") == 1
    first = study.client.get_metric_history(study.children[0].info.run_id, "objective")[0].value
    assert metrics["reduction_percent"] == pytest.approx(100 * (1 - min(objectives) / first))
    assert "search/analyses" not in metrics  # of its starts; together they are the evaluations
    assert metrics["search/evaluations"] >= sum(child.data.metrics["search/analyses"] for child in study.children) / 2
    assert metrics["search/failed_evaluations"] == 0
    assert tags["seed"] == "7"
    assert tags["version.torch"].startswith("2.")


def test_the_filed_config_runs_the_same_study(study):
    filed = study.folder / "mlartifacts" / study.parent.info.run_id / "artifacts" / "config.yaml"
    copy = study.folder / "again.yaml"
    copy.write_text(filed.read_text())
    assert load(copy).resolved() == load(study.folder / "study.yaml").resolved()
    assert study.parent.data.params["optimizer.name"] == "mmfd"
    assert study.parent.data.params["design.rod.laminate.angles.unit"] == "deg"


def test_pictures_are_filed(study):
    expected = {"config.yaml", "config_as_given.yaml", "design.yaml", "motion_start.html", "motion_best.html"}
    expected |= {"answer.json"}
    drawn = {"convergence.png", "design_map.png", "parallel_coordinates.png"}
    drawn |= {f"criteria_over_{what}.{kind}" for what in ("time", "iterations") for kind in ("png", "pdf")}
    assert files(study) == expected | {f"figures/{name}" for name in drawn}


def test_the_terminal_shows_iterations_table_and_links(study):
    lines = study.output.splitlines()
    first = next(line for line in lines if "iteration 0" in line)
    assert "start 0" in first
    assert "45.000   -45.000" in first
    table = "\n".join(lines[lines.index(next(line for line in lines if "2 starts" in line)) :])
    for child in study.children:
        assert f"{child.data.metrics['objective']:.6g}" in table
    assert "angle 1" in table
    assert f"viewStateShareKey={study.parent.info.run_id}" in table
    assert f"{study.parent.info.run_id}/artifacts/motion_best.html" in table


def test_the_view_of_the_table_names_metrics_that_exist(study):
    tags = study.client.get_experiment(study.parent.info.experiment_id).tags
    view = yaml.safe_load(tags[f"mlflow.sharedViewState.{study.parent.info.run_id}"])
    metrics = {column.partition("`")[2][:-1] for column in view["selectedColumns"] if column.startswith("metrics")}
    assert metrics <= set(study.children[0].data.metrics)
    assert {"objective", "design/angle_1_deg", "design/angle_2_deg"} <= metrics
    # MLflow shows attributes first, then metrics in their order: the status is the description of a start.
    assert view["selectedColumns"][:2] == ["attributes.`Description`", "metrics.`objective`"]
    # Charts of metrics without a group come first and are open, those of the others are folded.
    sections = {section["name"]: section["display"] for section in view["compareRunSections"]}
    assert next(iter(sections)) == "Model metrics"
    assert [name for name, is_open in sections.items() if is_open] == ["Model metrics"]
    of_children = {name.rpartition("/")[0] or "Model metrics" for name in study.children[0].data.metrics}
    assert of_children <= set(sections)
    for child in study.children:
        assert child.data.tags["mlflow.note.content"] == child.data.tags["status"].replace("_", " ")


def test_a_sweep_is_one_batch_with_a_run_for_each_point(sweep):
    assert sweep.code == 0
    values = [child.data.metrics["design/angle_2_deg"] for child in sweep.children]
    assert values == pytest.approx([-90, -45, 0, 45, 90])
    assert [child.data.metrics["design/angle_1_deg"] for child in sweep.children] == pytest.approx([45] * 5)
    ratios = [child.data.metrics["ratio"] for child in sweep.children]
    assert ratios[1] == pytest.approx(1.0)  # the start design is [45, -45]
    assert ratios[0] == pytest.approx(ratios[4], rel=1e-6)  # -90 and 90 degrees are one lay-up
    feasible = [
        m["objective"]
        for m in (child.data.metrics for child in sweep.children)
        if m["constraint/max of strain energy of rod"] <= 1e-6
    ]
    assert sweep.parent.data.metrics["best_objective"] == min(feasible)
    assert {"sweep.csv", "figures/sweep.png", "figures/sweep.pdf"} <= files(sweep)


def test_the_best_point_of_a_sweep_satisfies_the_constraints(run):
    """The integral of energy is least where it may not be below that of the start, [45, -45]: at the start, point 1."""
    along = {"rod.laminate.angles[1]": {"from": -90, "to": 90, "count": 5}}
    energy = {"integral": {"strain_energy": "rod"}}
    short = {"optimizer": None, "starts": None, "sweep": along, "simulate": {"duration": 0.002, "steps": 8}}
    limited = run("limited", **short, subject_to=[energy | {"at_least": "initial"}])
    objectives = [child.data.metrics["objective"] for child in limited.children]
    assert limited.parent.data.tags["best_point"] == "1"
    assert limited.parent.data.metrics["best_objective"] == objectives[1] > min(objectives)
    none = run("none", **short, subject_to=[energy | {"at_most": 1e-12}])
    assert "No design to report: no point satisfies all constraints; the nearest" in none.output
    assert "best_objective" not in none.parent.data.metrics


def test_the_peak_of_a_sweep_is_normalized_as_well(sweep):
    root = sweep.folder / "mlartifacts" / sweep.parent.info.run_id / "artifacts"
    text = (root / "sweep.csv").read_text().splitlines()
    assert text[0] == "angle_2_deg,integral of strain energy,max of strain energy"
    row = [float(x) for x in text[2].split(",")]
    assert row == pytest.approx([-45.0, 1.0, 1.0], rel=1e-6)
    constraint = [child.data.metrics["constraint/max of strain energy of rod"] for child in sweep.children]
    assert [float(line.split(",")[2]) for line in text[1:]] == pytest.approx([1 + c for c in constraint])


def test_a_study_whose_simulations_fail_says_so(run):
    """Three steps for 60 ms do not converge: failed evaluations, no exception, exit code 1."""
    failed = run("failed", simulate={"duration": 0.06, "steps": 3}, subject_to=[])
    assert failed.code == 1
    assert failed.parent.info.status == "FAILED"
    assert failed.parent.data.metrics["search/failed_evaluations"] >= 2
    assert "failed" in failed.parent.data.tags["last_failure"]
    assert [child.info.status for child in failed.children] == ["FAILED"] * 2
    assert "objective" not in failed.children[0].data.metrics
    assert "failed evaluations" in failed.output


def test_an_exception_leaves_failed_runs(run):
    """The limit "initial" needs the start design, which cannot be simulated: that ends the study."""
    broken = run("broken", raises=SimulationFailure, simulate={"duration": 0.06, "steps": 3})
    assert broken.parent.info.status == "FAILED"
    assert {child.info.status for child in broken.children} == {"FAILED"}
    assert math.isfinite(broken.parent.info.end_time)


def test_a_study_without_a_feasible_design_says_which_constraint_is_in_the_way(write, folder, empty_store):
    limits = [{"mass": "rod", "at_most": 1e-6}, {"max": {"strain_energy": "rod"}, "at_most": "initial"}]
    file = write(subject_to=limits, optimizer={"name": "slsqp", "max_iterations": 1}, starts=None)
    output = io.StringIO()
    tracker = MlflowTracker("none", f"sqlite:///{shutil.copy(empty_store, folder)}")
    plan = load(file, ["simulate.duration=0.002", "simulate.steps=8"])
    assert run_study(plan, Console(file=output, width=200), tracker) == 1
    assert (
        "no start ended with all constraints satisfied. The nearest is start 0: 'mass of rod' is beyond"
        in output.getvalue()
    )
