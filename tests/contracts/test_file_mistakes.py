"""Mistakes in experiment files: each is named with its line, path, value and what is allowed. No motion is computed.

A row: what is replaced in tests/study/study.yaml, by what, and what the message says: path and value, and what is allowed.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from torchmbd.study.file.faults import StudyError
from torchmbd.study.file.load import load

STUDY = Path(__file__).parents[1] / "study"
TEXT = (STUDY / "study.yaml").read_text()
MODEL, DESIGN = "model: rod_model.py:build", "start: [45, -45], lower: -90, upper: 90, unit: deg"
ENERGY, LIMIT = "{integral: {strain_energy: rod}}", "{max: {strain_energy: rod}, at_most: initial}"
TWO = "{at_times: {strain_energy: rod}, times: [0.001, 0.002]}"  # two rows
PLY, THICK = "rod.laminate.angles", "rod.laminate.thickness"
ANGLE = "{max: {angle: {body: rod, axis: z}}, "

MISTAKES = [
    # the file as a whole
    ("model: ", "modl: ", ["line 2: modl = ", "Try: 'model'"]),
    (MODEL + "\n", "", ["model is missing", "must be package.module:function"]),
    ("tracking: {experiment: test}", "tracking: {}\ntracking: {}", ["tracking is given twice", "must be given once"]),
    ("seed: 7", "seed: &a 7", ["starts.seed", "anchors (&)", "must be plain values"]),
    ("seed: 7", "seed: !!int 7", ["starts.seed", "tag", "must be a plain value"]),
    ("seed: 7", "seed: 007", ["starts.seed = '007'", "must be a valid integer"]),
    ("seed: 7", "seed: 1e400", ["starts.seed = 1e400", "must be at most 1.8e308"]),
    (TEXT, "3", ["is 3", "must have sections such as model:"]),
    # model and options
    (MODEL, "model: 7", ["model = 7", "must be a valid string"]),
    (MODEL, "model: rod_model.py", ["model = 'rod_model.py'", "must be package.module:function"]),
    (MODEL, "model: rod_model.py:bild", ["'rod_model.py:bild'", "Try: 'build'"]),
    (MODEL, "model: nowhere.py:build", ["nowhere.py' does not exist", "must be a Python file"]),
    (MODEL, "model: no.where:build", ["'no.where' cannot be imported", "must be "]),
    (MODEL, "model: ../x.py:build", ["'../x.py'", "must be a Python file in"]),
    (MODEL, "model: rod_model.py:no_system", ["-> int", "must be annotated with -> System"]),
    ("layers: 2", "layer: 2", ["options.layer = 2 is not an option", "Try: 'layers'"]),
    ("{layers: 2}", "[layers, 2]", ["options = ['layers', 2]", "must be a mapping"]),
    # design
    (
        "rod.laminate.angles:",
        "rod.laminate.angle:",
        ["design.rod.laminate.angle", "Try: 'rod.laminate.angles'"],
    ),
    (DESIGN, "start: [45], lower: -90, upper: 90, unit: deg", ["start = [45.0] has 1 values", "must have 2"]),
    (
        DESIGN,
        "start: [45, 95], lower: -90, upper: 90, unit: deg",
        ["start = [45.0, 95.0]: [1] = 1.65806 rad (95 deg)", "must lie between -1.5708 rad (-90 deg)"],
    ),
    (DESIGN, "start: [a, 1], lower: -90, upper: 90, unit: deg", ["start.0 = 'a'", "must be a valid number"]),
    (
        DESIGN,
        "lower: 50, upper: 90, unit: deg",
        [f"design.{PLY}.start is not given", "(45 deg)", "must lie between 0.872665 rad (50 deg)"],
    ),
    (
        DESIGN,
        "lower: 90, upper: -90, unit: deg",
        ["lower = 90", "[0] = 1.5708 rad (90 deg)", "must be below upper = -1.5708 rad (-90 deg)"],
    ),
    (DESIGN, "upper: 90, unit: deg", ["lower is missing", "must be a number"]),
    (DESIGN, "lower: -90, upper: 90", ["unit is missing", "must be one of deg, rad"]),
    (DESIGN, "lower: -90, upper: 90, unit: degrees", ["unit = 'degrees'", "Try: 'deg'"]),
    (DESIGN, "lower: -90, upper: 90, uint: deg", ["uint = 'deg' is an unknown key", "Try: 'unit'"]),
    (
        DESIGN,
        "lower: -90, upper: 90, unit: rad",
        ["lower = -90.0 with unit: rad", "must lie in the range -2 pi to 2 pi. Try: unit: deg"],
    ),
    (DESIGN, "lower: -90, upper: 90, unit: mm", ["unit = 'mm'", "must be one of deg, rad"]),
    (DESIGN, "lower: -90, upper: 90, unit: deg, step: -5", ["step = -5", "must not be negative"]),
    (DESIGN, "lower: -90, upper: 90, unit: deg, tolerance: -1", ["tolerance = -1", "must not be negative"]),
    ("  rod.laminate.angles: {" + DESIGN + "}", "  {}", ["design is empty", "must have at least one parameter"]),
    # simulate
    ("duration: 0.01", "duration: 0", ["simulate.duration = 0", "must be greater than 0"]),
    ("duration: 0.01", "duration: 10 ms", ["simulate.duration = '10 ms'", "must be a valid number"]),
    ("duration: 0.01, ", "", ["simulate.duration is missing", "must be a number"]),
    ("steps: 60", "steps: 6.5", ["simulate.steps = 6.5", "must be a valid integer"]),
    ("steps: 60", "steps: -1", ["simulate.steps = -1", "must be greater than 0"]),
    ("steps: 60", "step: 60", ["simulate.step = 60", "is not an option of method", "Try: 'steps'"]),
    ("steps: 60", "steps: 60, method: rk5", ["simulate.method = 'rk5'", "Try: 'rk4'"]),
    ("steps: 60", "steps: 60, gradients: 2", ["simulate.gradients = 2", "must be a valid string"]),
    (
        "steps: 60",
        "steps: 60, gradients: backward",
        ["simulate.gradients = 'backward'", "must be one of auto, forward"],
    ),
    ("steps: 60", "steps: 60, gradients: reverse, method: rk4", ["'reverse'", "method = 'generalized_alpha'"]),
    (
        "steps: 60",
        "steps: 60, backend: cuda",
        ["simulate.backend", "backend = 'cuda': must be one of", "must be one of auto, eager"],
    ),
    (
        "steps: 60",
        "steps: 60, spectral_radus: 0.5",
        ["simulate.spectral_radus = 0.5", "is not an option of method", "Try: 'spectral_radius'"],
    ),
    ("steps: 60", "steps: 60, iterations: 3", ["simulate.iterations = 3", "must be two positive integers"]),
    ("steps: 60", "steps: 60, phases: rod_model.py:no_phases", ["simulate.phases", "must return a list of mbd.Phase"]),
    # minimize and subject_to
    (ENERGY, "{integral: {strain_energy: rodd}}", ["minimize.integral.strain_energy", "'rodd'", "Try: 'rod'"]),
    (ENERGY, "{integrl: {strain_energy: rod}}", ["minimize.integrl", "Try: 'integral'"]),
    (ENERGY, "{integral: rod}", ["minimize.integral = 'rod'", "must be a mapping"]),
    (ENERGY, "{}", ["minimize has 0 keys", "must have exactly one"]),
    (ENERGY, "{integral: {strain_energy: rod}, window: [0.2, 0.1]}", ["[0.2, 0.1]", "must satisfy 0 <= t0 < t1"]),
    (ENERGY, "{integral: {strain_energy: rod}, windw: [0, 1]}", ["minimize.windw", "Try: 'window'"]),
    (ENERGY, "{max: {position: {body: rod, axis: w}}}", ["minimize.max.position", "'w'", "must be 'x', 'y', 'z'"]),
    (ENERGY, "{max: {position: {body: rod}}}", ["minimize.max.position", "'axis'", "must have "]),
    (ENERGY, "{max: {position: {body: rod, axis: x, nod: 1}}}", ["nod", "Try: 'node'"]),
    (ENERGY, "{frequency: {body: rod, number: 9}}", ["frequency.number = 9", "must be 1 to 4"]),
    (
        ENERGY,
        "{max: {function: rod_model.py:plain}}",
        ["max.function", "does not say what", "must be annotated with -> Tensor"],
    ),
    (
        ENERGY,
        "{max: {function: rod_model.py:no_phases}}",
        ["annotated -> list", "must be annotated with -> Tensor or -> History"],
    ),
    (ENERGY, "{max: {ply_failure: rod}}", ["minimize.max.ply_failure", "Try: Ply(..., strength="]),
    (ENERGY, "{weighted_sum: 3}", ["minimize.weighted_sum = 3", "must be a list"]),
    (ENERGY, "{weighted_sum: [{mass: rod}]}", ["minimize.weighted_sum.0", "weight", "must be "]),
    (ENERGY, "{weighted_sum: [{weight: a, mass: rod}]}", ["weighted_sum.0.weight = 'a'", "must be a number"]),
    (LIMIT, "{max: {strain_energy: rod}, at_most: start}", ["subject_to.0.at_most = 'start'", "must be 'initial'"]),
    (LIMIT, "{max: {strain_energy: rod}, at_more: 1}", ["subject_to.0.at_more", "must be "]),
    (LIMIT, "{max: {strain_energy: rod}}", ["subject_to.0: has no limit", "must have exactly one of at_most"]),
    (LIMIT, "{max: {strain_energy: rod}, at_most: 1, equal: 2}", ["at_most and equal", "must have exactly one"]),
    (LIMIT, "{max: {strain_energy: rod}, at_most: 1, scale: 0}", ["subject_to.0.scale = 0", "must be greater than 0"]),
    (
        LIMIT,
        LIMIT[:-1] + ", window: [0, 1]}",
        ["subject_to.0", "looks at t = 1 s", "must look at most at duration=0.01 s"],
    ),
    (
        LIMIT,
        ANGLE + "at_most: 0.5}",
        ["subject_to.0: has a limit of an angle (0.5) and no unit", "must have unit: deg"],
    ),
    (LIMIT, ANGLE + "at_most: 0.5, unit: mm}", ["unit: mm", "must have one of the units deg, rad"]),
    (LIMIT, ANGLE + "at_most: 0.5, unit: degree}", ["subject_to.0.unit = 'degree'", "Try: 'deg'"]),
    (LIMIT, "3", ["subject_to.0 = 3", "must be a mapping"]),
    # optimizer, starts, sweep, tracking
    ("name: mmfd", "name: mmdf", ["optimizer.name = 'mmdf'", "Try: 'mmfd'"]),
    ("max_iterations: 2", "max_iterations: -2", ["optimizer.max_iterations = -2", "must be greater than 0"]),
    (
        "max_iterations: 2",
        "max_iteration: 2",
        ["optimizer.max_iteration = 2", "Try: 'max_iterations'"],
    ),
    ("max_iterations: 2", "max_lanes: many", ["optimizer.max_lanes = 'many'", "must be an integer"]),
    ("sampler: sobol", "sampler: sobel", ["starts.sampler = 'sobel'", "Try: 'sobol'"]),
    ("count: 2, ", "", ["starts: sampler 'sobol' needs 'count'", "must be sobol and latin_hypercube with count"]),
    ("count: 2", "count: 0", ["starts.count = 0", "must be greater than 0"]),
    ("count: 2", "count: 2000000", ["starts.count = 2000000", "must be less than or equal to 1048576"]),
    ("seed: 7", "seed: seven", ["starts.seed = 'seven'", "must be a valid integer"]),
    ("sampler: sobol, count: 2, seed: 7", "sampler: given, points: [[1]]", ["starts.points.0 = [1.0]", "must have 2"]),
    (
        "sampler: sobol, count: 2, seed: 7",
        "sampler: given, points: [[1, 95]]",
        ["[1.0, 95.0]", "(95 deg): must lie between -1.5708 rad (-90 deg) and"],
    ),
    ("experiment: test", "experiment: ''", ["tracking.experiment = ''", "must have at least 1 character"]),
    ("experiment: test", "uri: mlflow.db", ["tracking.uri = 'mlflow.db'", "such as sqlite:"]),
    (
        "experiment: test",
        "experimnt: test",
        ["tracking.experimnt = 'test' is an unknown key", "Try: 'experiment'"],
    ),
    # what is asked, links, tolerances, scenarios
    ("minimize:", "maximise:", ["maximise = ", "Try: 'maximize'"]),
    ("minimize: " + ENERGY + "\n", "", ["minimize is missing", "must be a response", "maximize: or tradeoff:"]),
    (
        LIMIT,
        LIMIT + "\nmaximize: {mass: rod}",
        ["maximize and minimize are both given", "must not be given together"],
    ),
    (
        "minimize: " + ENERGY,
        "maximize: " + TWO,
        ["maximize = AtTimes", "of 2 rows", "must be a measure of one number"],
    ),
    ("minimize: " + ENERGY, "tradeoff: {a: {mass: rod}}", ["tradeoff has 1 keys", "must have 2 or more"]),
    ("minimize: " + ENERGY, f"tradeoff: {{a: {{mass: rod}}, b: {TWO}}}", ["tradeoff.b", "has 2 rows", "must be "]),
    (
        "minimize: " + ENERGY,
        "tradeoff: {a: {mass: rod}, b: {max: {function: rod_model.py:plain}}}",
        ["tradeoff.b.max.function = 'rod_model.py:plain'", "must be annotated with -> Tensor"],
    ),
    ("minimize: " + ENERGY, "tradeoff: {a: {mass: rod}, b: {mas: rod}}", ["tradeoff.b.mas", "Try: 'mass'"]),
    ("tracking:", "robust: worst\ntracking:", ["must have a variable with a tolerance", "in design"]),
    ("tracking:", "robust: worse\ntracking:", ["robust = 'worse'", "Try: 'worst'"]),
    (
        "tracking:",
        f"links: {{'{PLY}[2]': {{'{PLY}[0]': -1}}}}\ntracking:",
        [f"{PLY}[2] is not an entry", "Try:"],
    ),
    ("tracking:", f"links: {{'{PLY}[1]': {{'{PLY}[0]': a}}}}\ntracking:", ["= 'a'", "must be a valid number"]),
    ("tracking:", f"links: {{'{PLY}[1]': {{{PLY}[0]: -1}}}}\ntracking:", ["not YAML", "got '['", "Try: within"]),
    (
        "tracking:",
        f"links: {{'{PLY}[1]': {{'{PLY}[0]': -1}}}}\ntracking:",
        ["start = [45.0, -45.0] has 2 values", "must have 1 (of [0]; the others follow)"],
    ),
    ("tracking:", f"links: {{'{PLY}[1]': {{constnt: 1}}}}\ntracking:", ["constnt", "Try: 'constant'"]),
    (
        "tracking:",
        "scenarios: [{set: {slider.mas: 1.0}}]\ntracking:",
        ["scenarios.0.set.slider.mas", "must be one of rod"],
    ),
    ("tracking:", "scenarios: [{set: {slider.mas: 1.0}}]\ntracking:", ["mbd.variable", "options: "]),
    (
        "tracking:",
        f"scenarios: [{{set: {{{THICK}: {{value: 1, unit: deg}}}}}}]\ntracking:",
        ["thickness.unit = 'deg'", "mm, um"],
    ),
    ("tracking:", f"scenarios: [{{set: {{{PLY}: 1.0}}}}]\ntracking:", ["because it is an angle", "unit: deg"]),
    (
        "tracking:",
        f"scenarios: [{{set: {{{PLY}: {{value: 1, unit: deg}}}}}}]\ntracking:",
        [f"scenarios.0.set.{PLY}", "a design variable", "must be a parameter that is not a design variable"],
    ),
    ("tracking:", f"scenarios: [{{set: {{{THICK}: [1.0]}}}}]\ntracking:", ["has 1 values", "must have 2"]),
    (
        "tracking:",
        f"scenarios: [{{set: {{{THICK}: 0.003}}, weight: 0}}]\ntracking:",
        ["all 0", "must have at least one positive weight"],
    ),
    (
        "tracking:",
        "combine: {objective: mean}\ntracking:",
        ["combine is given without scenarios", "must be given with them"],
    ),
    # what the methods refuse
    ("steps: 60", "steps: 60, spectral_radius: 1.5", ["simulate.spectral_radius = 1.5", "must be 0"]),
    ("max_iterations: 2", "feasibility: -1", ["optimizer.feasibility = -1", "must lie in [0, 1]"]),
    ("max_iterations: 2", "max_lanes: 0", ["optimizer.max_lanes = 0", "must lie in"]),
    # the text itself
    ("seed: 7", "seed: \x07", ["is not YAML: unacceptable character", "must have printable characters"]),
    (TEXT, "", ["is null", "must have sections such as model:"]),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mistakes")
    shutil.copy(STUDY / "rod_model.py", folder)
    return folder


@pytest.mark.parametrize(("old", "new", "words"), MISTAKES, ids=[str(k) for k in range(len(MISTAKES))])
def test_line_path_value_and_what_is_allowed_are_named(folder, old, new, words):
    assert old in TEXT
    file = folder / "study.yaml"
    file.write_text(TEXT.replace(old, new))
    with pytest.raises(StudyError) as error:
        load(file)
    text = str(error.value)
    for word in words:
        assert word in text
    assert all(isinstance(fault.where, int) for fault in error.value.faults), text
    assert all("Try: " in str(fault) or "must" in str(fault) for fault in error.value.faults), text


def test_there_are_many():
    assert len(MISTAKES) >= 60
