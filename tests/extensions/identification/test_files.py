"""Experiment files that fit a model to measurements: run, killed and continued, loaded by another study, and what is wrong."""

from __future__ import annotations

import csv
import io
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rich.console import Console

import torchmbd as mbd
from torchmbd.cli import main
from torchmbd.errors import InputError
from torchmbd.extensions.identification.fit_problem import FitProblem
from torchmbd.extensions.identification.plan import IdentificationPlan
from torchmbd.extensions.identification.tracked_fit import run_identification
from torchmbd.study.file.load import load
from torchmbd.study.report.html import write_report

pytestmark = pytest.mark.thorough

CONFIG = Path(__file__).parents[3] / "configs" / "pendulum_rig" / "friction.yaml"
MODEL = """
import torchmbd as mbd

def build(speed: float = 1.5) -> mbd.System:
    bob = mbd.RigidBody("bob", mbd.variable(1.0), (0.01, 0.01, 0.01), position=(0, -1, 0), angular_velocity=(0, 0, speed))
    hinge = mbd.Revolute(mbd.Ground().at(), bob.at(0, 1, 0), "z", "hinge")
    drag = mbd.RotationalSpringDamper(mbd.Ground().at(), bob.at(), damping=mbd.variable(0.3), name="drag")
    return mbd.System([bob], [hinge], [drag], gravity=(0, -9.81, 0))
"""
STUDY = """
# How strong is the drag?
model: model.py:build
simulate: {steps: 60, backend: eager}
identify:
  unknowns:
    drag.damping: {lower: 0, upper: 2, unit: none}
    angle.delay: {lower: 0, upper: 50, unit: ms}
  experiments:
    swing:
      time_series:
        file: swing.csv
        channels:
          angle: {angle: {body: bob, axis: z}, unit: deg, deviation: 0.05}
  validation:
    slow:
      options: {speed: 0.5}
      time_series:
        file: slow.csv
        channels:
          angle: {angle: {body: bob, axis: z}, unit: deg, deviation: 0.05, delay: angle.delay}
tracking: {experiment: rig}
"""
DRAG, DELAY = 0.8, 0.02


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Path:
    """A folder with a model, two files of measured angles and an experiment file."""
    path = tmp_path_factory.mktemp("rig")
    (path / "model.py").write_text(MODEL, encoding="utf-8")
    (path / "study.yaml").write_text(STUDY, encoding="utf-8")
    space: dict[str, Any] = {}
    exec(MODEL, space)
    for name, speed in (("swing", 1.5), ("slow", 0.5)):
        designs = {"drag.damping": mbd.variable(DRAG).detach()[None]}
        options: dict[str, Any] = {"designs": designs, "gradients": "none", "backend": "eager"}
        motion = mbd.simulate(space["build"](speed), 1.2, steps=480, **options)
        t = np.arange(0.05, 1.15, 0.01)
        angle = np.degrees(np.interp(t - DELAY, motion.t.numpy(), mbd.Angle("bob", "z")(motion)[0].numpy()))
        angle += 0.05 * np.random.default_rng(3).standard_normal(len(t))
        rows = [f"{x:.3f},{y:.4f}" for x, y in zip(t, angle, strict=True)]
        (path / f"{name}.csv").write_text("\n".join(["t,angle [deg]", *rows, ""]), encoding="utf-8")
    return path


@pytest.fixture
def folder(rig, tmp_path, empty_store, monkeypatch) -> Path:
    """A copy of it, with an empty store."""
    shutil.copytree(rig, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCHMBD_STORE", str(tmp_path / "evaluations"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{shutil.copy(empty_store, tmp_path / 'mlflow.db')}")
    return tmp_path


def plan(*overrides: str) -> IdentificationPlan:
    _, result = load("study.yaml", overrides)
    assert isinstance(result, IdentificationPlan)
    return result


def artifacts(folder: Path) -> Path:
    [path] = (folder / "mlartifacts").glob("*/artifacts")
    return path


def table(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


def test_a_fit_is_tracked_and_its_model_is_one_for_other_studies(folder, capsys):
    assert main(["run", "study.yaml"]) == 0
    said = capsys.readouterr().out
    assert "2 unknowns, 110 measured numbers, 1 start" in said
    assert "held out" in said
    files = artifacts(folder)
    rows = {row["unknown"]: row for row in table(files / "unknowns.csv")}
    drag, delay = rows["drag.damping[0]"], rows["angle.delay[0]"]
    assert delay["unit"] == "ms"
    for row, truth in ((drag, DRAG), (delay, 1e3 * DELAY)):
        assert abs(float(row["value"]) - truth) < 3.0 * float(row["deviation"]) < 0.05 * truth
    headings = list(table(files / "data_swing.angle.csv")[0])
    assert headings == ["t [s]", "data [rad]", "start [rad]", "fitted [rad]"]
    data = np.genfromtxt(files / "data_swing.angle.csv", delimiter=",", skip_header=1)
    before, after = (np.sqrt(np.mean((data[:, k] - data[:, 1]) ** 2)) for k in (2, 3))
    assert after < 1.2 * np.radians(0.05) < 0.1 * before
    assert [row["held_out"] for row in table(files / "channels.csv")] == ["False", "True"]
    assert {x.name for x in (files / "figures").iterdir()} == {"data_and_model.png", "held_out.png"}

    fitted = yaml.safe_load((files / "fitted.yaml").read_text(encoding="utf-8"))
    assert list(fitted) == ["drag.damping"]
    Path("fitted.yaml").write_text((files / "fitted.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    Path("other.yaml").write_text(
        "# How far does it swing?\nmodel: model.py:build\nparameters: fitted.yaml\n"
        "simulate: {duration: 0.2, steps: 20, backend: eager}\n"
        "design: {bob.mass: {lower: 0.5, upper: 2, unit: kg}}\nminimize: {final: {position: {body: bob, axis: x}}}\n",
        encoding="utf-8",
    )
    other = mbd.Study.from_file("other.yaml")
    assert other.system is not None
    assert float(other.system.get_parameter("drag.damping")) == pytest.approx(fitted["drag.damping"]["value"])
    assert other.resolved()["parameters"]["drag.damping"]["value"] == fitted["drag.damping"]["value"]
    again = mbd.Study.from_file("other.yaml", "parameters.drag.damping.value=0.7")
    assert again.system is not None
    assert float(again.system.get_parameter("drag.damping")) == 0.7

    assert main(["run", "study.yaml"]) == 0
    assert "nothing is run again" in capsys.readouterr().out
    assert main(["best", "study"]) == 0
    said = capsys.readouterr().out
    [row] = [line.split() for line in said.splitlines() if line.split()[:1] == ["drag.damping[0]"]]
    assert float(row[2]) == pytest.approx(fitted["drag.damping"]["value"], rel=1e-4)
    assert "mbd.Study" not in said  # no class of that name makes a fit
    page = write_report("study", folder / "report.html").read_text(encoding="utf-8")
    assert "drag.damping[0]" in page
    assert page.count("data:image/png") == 2


def test_a_fit_that_was_killed_continues_with_what_was_evaluated(folder, monkeypatch):
    """Killed at the third design; continued, it computes the others alone, and ends where an unbroken fit does."""
    evaluate, count = FitProblem.evaluate, {"designs": 0}

    def killed(self, X, gradients):
        count["designs"] += len(X)
        if count["designs"] > 3:
            raise KeyboardInterrupt
        return evaluate(self, X, gradients)

    console = Console(file=io.StringIO(), width=200)
    monkeypatch.setattr(FitProblem, "evaluate", killed)
    assert run_identification(plan(), console) == 130
    monkeypatch.setattr(FitProblem, "evaluate", evaluate)
    assert run_identification(plan(), console) == 0
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert "3 evaluations of this problem are on disk" in text
    continued = (artifacts(folder) / "unknowns.csv").read_text(encoding="utf-8")
    assert run_identification(plan(), console, fresh=True) == 0
    files = [x / "unknowns.csv" for x in (folder / "mlartifacts").glob("*/artifacts")]
    assert all(x.read_text(encoding="utf-8") == continued for x in files)


def test_check_says_how_far_the_model_is(folder, capsys):
    assert main(["check", "study.yaml"]) == 0
    said = capsys.readouterr().out
    assert "is valid: 2 unknowns, 110 measured numbers in 1 channels, 1 experiments, 1 held out" in said
    assert re.search(r"angle +110 +[\d.]+ rad", said)
    assert not list((folder / "evaluations").glob("*/study.json"))


SPRUNG = """
import torchmbd as mbd

def build() -> mbd.System:
    ground, block = mbd.Ground(), mbd.RigidBody("block", mbd.variable(1.0), (0.01, 0.01, 0.01))
    slide = mbd.Prismatic(ground.at(), block.at(), axis="x", name="slide")
    spring = mbd.AxialSpringDamper(ground.at(), block.at(), axis="x", stiffness=mbd.variable(120.0), name="spring")
    return mbd.System([block], [slide], [spring, mbd.Force(block.at(), (mbd.variable(0.0), 0.0, 0.0), name="push")])
"""
OTHER_KINDS = """
# How stiff is the spring, and how heavy the block?
model: sprung.py:build
identify:
  unknowns:
    spring.stiffness: {lower: 50, upper: 500, unit: none}
    block.mass: {lower: 0.5, upper: 5, unit: kg}
  experiments:
    pulled:
      static_curve:
        file: curve.csv
        loads: {push.x: F}
        channels:
          x: {position: {body: block, axis: x}, unit: mm, deviation: 0.01}
    ringing:
      modal_data: {frequencies: [1.5915494]}
    shaken:
      frequency_responses:
        file: shaken.csv
        input: {name: slide}
        outputs: {a: {name: block, direction: x, place: [0, 0.1, 0]}, v: {name: slide}}
        quantity: acceleration
        deviation: {a: 0.001, v: 0.001}
"""


def other_kinds(folder: Path) -> None:
    """A spring of 200 N/m and a block of 2 kg: a curve of loads, a frequency, accelerations by a harmonic force."""
    (folder / "sprung.py").write_text(SPRUNG, encoding="utf-8")
    (folder / "kinds.yaml").write_text(OTHER_KINDS, encoding="utf-8")
    (folder / "curve.csv").write_text("F [N],x [mm]\n1,5.00\n2,10.00\n4,20.00\n", encoding="utf-8")
    rows = ["frequency [Hz],a real,a imaginary,v real,v imaginary"]
    for f in (0.5, 1.0, 3.0):
        square = (2.0 * math.pi * f) ** 2
        inertance = -square / (200.0 - 2.0 * square)
        rows.append(f"{f},{inertance},0,{inertance},0")
    (folder / "shaken.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def test_static_curves_frequencies_and_responses(folder):
    other_kinds(folder)
    _, result = load("kinds.yaml")
    assert isinstance(result, IdentificationPlan)
    assert run_identification(result, Console(file=io.StringIO())) == 0
    values = {row["unknown"]: float(row["value"]) for row in table(artifacts(folder) / "unknowns.csv")}
    assert values["spring.stiffness[0]"] == pytest.approx(200.0, rel=1e-4)
    assert values["block.mass[0]"] == pytest.approx(2.0, rel=1e-4)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            "identify.experiments.pulled.static_curve.loads={push.y: F}",
            r"pulled\.static_curve\.loads\.push\.y.*push\.x",
        ),
        (
            "identify.experiments.pulled.static_curve.loads={push.x: G}",
            r"static_curve\.loads.*column = 'G'",
        ),
        ("identify.experiments.ringing.modal_data.frequencies=[2, 1]", r"ringing\.modal_data.*ascending"),
        (
            "identify.experiments.shaken.frequency_responses.outputs={a: {name: blok, direction: x}}",
            r"responses\.outputs\.a: name = 'blok': must be one of the joints \['slide'\] or of the bodies \['block'\]",
        ),
        ("identify.experiments.shaken.frequency_responses.input={name: block}", r"responses\.input: direction is None"),
        ("identify.experiments.shaken.frequency_responses.file=none.csv", r"frequency_responses.*none\.csv"),
        ("identify.experiments.shaken.frequency_responses.quantity=jerk", r"quantity = 'jerk'.*acceleration"),
        ("identify.experiments.shaken.frequency_responses.deviation={b: 1}", r"frequency_responses.*'b'.*a, v"),
        ("identify.experiments.ringing={duration: 1.0}", r"ringing: measures nothing: must have time_series or"),
    ],
)
def test_mistakes_of_other_kinds_are_named(folder, override, message):
    other_kinds(folder)
    with pytest.raises(InputError, match=message):
        load("kinds.yaml", [override])


CHANNEL = "identify.experiments.swing.time_series.channels.angle"
MISTAKES = {
    "a body that the model has not": (f"{CHANNEL}={{angle: {{body: bab, axis: z}}}}", r"angle.*'bab'.*bob"),
    "a response that does not exist": (f"{CHANNEL}={{angel: {{body: bob, axis: z}}}}", r"angel.*angle"),
    "a column that the file has not": (f"{CHANNEL}.column=angl", r"angle: .*column = 'angl'.*'angle'"),
    "an impossible unit of a column": (
        f"{CHANNEL}={{angle: {{body: bob, axis: z}}, column: angle, unit: mm}}",
        r"channels\.angle.*(heading says \[deg\]|\[m\])",
    ),
    "a unit that does not exist": (f"{CHANNEL}.unit=degree", r"unit = 'degree'.*deg"),
    "an unknown that nothing has": (
        "identify.unknowns={drag.dumping: {lower: 0, upper: 1, unit: none}}",
        r"drag\.dumping is not a parameter of the model or a number of a sensor.*'drag\.damping'",
    ),
    "an impossible unit of a delay": ("identify.unknowns.angle.delay.unit=mm", r"angle\.delay\.unit = 'mm'.*s, ms"),
    "a delay without bounds": (
        "identify.unknowns.angle.delay={lower: 0, unit: ms}",
        r"bounds of angle\.delay.*must be finite",
    ),
    "bounds the wrong way": (
        "identify.unknowns.drag.damping={lower: 2, upper: 1, unit: none}",
        r"drag\.damping.*lower bound .* must be below upper",
    ),
    "a prior without spread": (
        "identify.unknowns.drag.damping={lower: 0, upper: 1, unit: none, prior: {mean: 0.5, deviation: 0}}",
        r"drag\.damping\.prior.*above 0",
    ),
    "a file that is not there": (
        "identify.experiments.swing.time_series.file=swung.csv",
        r"time_series\.file.*No such file",
    ),
    "a sensor that no channel has": (
        f"{CHANNEL}.gain=angle.gein",
        r"gain = 'angle.gein' is not a sensor.*'angle.gain'",
    ),
    "a loss that does not exist": ("identify.loss=hubber", r"loss = 'hubber'.*huber"),
    "options of a model": ("identify.experiments.swing.options={sped: 1}", r"swing\.options\.sped.*speed"),
    "an experiment that is held out too": (
        "identify.validation={swing: {time_series: {file: swing.csv, channels: {angle: {angle: {body: bob, axis: z}}}}}}",
        r"validation\.swing.*must have another name than the experiments",
    ),
    "a parameter that the model has not": ("parameters={bob.mas: 1.0}", r"parameters\.bob\.mas.*bob\.mass"),
    "a parameter that cannot be": ("parameters={bob.mass: -1.0}", r"parameters\.bob\.mass.*positive"),
    "an option of the motion": ("simulate.stepps=5", r"simulate\.stepps = 5.*is not an option.*Try: 'steps'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_named(folder, mistake):
    override, message = MISTAKES[mistake]
    with pytest.raises(InputError, match=message) as caught:
        load("study.yaml", [override])
    assert "Traceback" not in str(caught.value)


def test_faults_have_lines_and_come_together(folder):
    Path("study.yaml").write_text(
        STUDY.replace("drag.damping: {lower", "drag.dumping: {lower").replace(
            "{body: bob, axis: z}", "{body: bub, axis: z}", 1
        ),
        encoding="utf-8",
    )
    with pytest.raises(InputError, match=r"study\.yaml: 2 errors") as caught:
        load("study.yaml")
    assert "line 7: identify.unknowns.drag.dumping" in str(caught.value)
    assert "line 14: identify.experiments.swing.time_series.channels.angle" in str(caught.value)


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (5, "0.070,1.0", r"swing\.csv, line 6: time .* follows"),
        (4, "0.080,one", r"swing\.csv, line 5.*'one'"),
        (4, "0.080,inf", r"swing\.csv, line 5.*channel 'angle' = inf"),
    ],
)
def test_lines_of_the_data_are_named(folder, line, text, message):
    rows = Path("swing.csv").read_text(encoding="utf-8").splitlines()
    rows[line] = text
    Path("swing.csv").write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        load("study.yaml")


def test_the_rig_of_the_tutorial(tmp_path, monkeypatch, compiled):
    """The fit of configs/pendulum_rig finds the numbers of the twin within its intervals."""
    monkeypatch.chdir(tmp_path)
    from experiments.models.pendulum_rig import DELAY, TRUTH, measured

    _, result = load(CONFIG)
    assert isinstance(result, IdentificationPlan)
    fit = mbd.identification.identify(result.experiments, validation=result.validation, **result.arguments)
    for name, truth in (TRUTH | {"release_40.angle.delay": DELAY}).items():
        k = fit.names.index(f"{name}[0]")
        assert abs(fit.x[k] - truth) < 3.0 * fit.deviation[k], name
    assert fit.validation[0].chi_square == pytest.approx(1.0, abs=0.25)
    t, angle = measured(40.0, 0)
    data = np.genfromtxt(CONFIG.parent / "release_40.csv", delimiter=",", skip_header=1)
    assert np.abs(data - np.stack([1e3 * t, angle], 1)).max() < 2e-3
