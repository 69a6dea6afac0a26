"""Descriptions of the keys of an experiment file, for editors (json_schema.py) and for the reference page.

A section is a class of schema.py. Checked in tests/study/test_json_schema.py: every key has one.
"""

from __future__ import annotations

KEYS: dict[str, dict[str, str]] = {
    "StudyFile": {
        "model": "The function that returns the System: path/to/file.py:function or package.module:function.",
        "options": "Arguments of the model's function.",
        "design": "Design variables: parameters of the model with bounds and a unit.",
        "links": "Entries of `design` that follow others: entry -> {entry: factor, constant: offset}.",
        "simulate": "The motion: duration, steps, start, method.",
        "minimize": "The response that is to be small.",
        "maximize": "The response that is to be large; stands instead of `minimize`.",
        "tradeoff": "Named responses whose Pareto front is sought; stands instead of `minimize`.",
        "robust": "What is asked over the tolerances of `design`: `expected`, the mean, or `worst`.",
        "subject_to": "Constraints, all of which hold.",
        "scenarios": "Load cases or settings in which one design is simulated.",
        "combine": "What is asked of objective and constraints over the scenarios.",
        "optimizer": "The method of optimization with its options.",
        "starts": "Designs from which the optimizer starts.",
        "sweep": "One entry of `design` with a range: evaluated along it; stands instead of `optimizer` and `starts`.",
        "tracking": "Where MLflow keeps the runs.",
    },
    "Figures": {
        "figures": "The function that draws into a folder: path/to/file.py:function or package.module:function.",
        "options": "Arguments of this function; `folder` is given by the program.",
        "tracking": "Where MLflow keeps the runs.",
    },
    "Variable": {
        "start": "First value, one or a list; default: as the model is built.",
        "lower": "Lower bound, one or a list.",
        "upper": "Upper bound, one or a list.",
        "unit": "Unit of all numbers of this variable; `none`: the SI unit.",
        "tolerance": "Largest deviation when it is made; the question is then asked over all deviations.",
        "step": "The study ends with multiples of it; 0: any value.",
    },
    "Simulation": {
        "duration": "Simulated time [s].",
        "method": "Method of time integration.",
        "steps": "Number of steps; default: as many as the responses of the start design need.",
        "tolerance": "Error by steps of every response, as a share of it or of its limit, that chosen steps may have.",
        "phases": "Function that returns the phases: path/to/file.py:function or package.module:function.",
        "backend": "`native` code, `eager` operators of torch, or `auto`: native where a compiler is found.",
        "start": "`assembled`: undeformed; `equilibrium`: at rest under its loads; or values by name.",
        "gradients": "`reverse`: adjoint; `forward`: tangents; `auto`: the cheaper one.",
        "iterations": "Corrections of values in a step, and least number of those of tangents; default: 3 and 1, or 4 and 1.",
        "refresh": "Steps between two inverses of the iteration matrix; 0: a new one before every correction.",
        "halvings": "How many times the step of a motion that fails may be halved.",
        "checkpoint": "Every which state is kept; the adjoint computes those between again.",
        "spectral_radius": "Numerical damping of generalized_alpha: 1 none, 0 most.",
        "alpha": "Numerical damping of hht_alpha: 0 none, -1/3 most.",
        "rtol": "Relative tolerance of methods that choose their steps.",
        "atol": "Absolute tolerance of methods that choose their steps.",
        "options": "Further options of the method of torchdiffeq.",
    },
    "Constraint": {
        "at_most": "Largest allowed value; `initial`: the value at the start design.",
        "at_least": "Smallest allowed value; `initial`: the value at the start design.",
        "equal": "Required value; `initial`: the value at the start design.",
        "scale": "What a violation is divided by; default: the limit.",
        "unit": "Unit of limit and scale; default: SI; an angle needs one.",
    },
    "Scenario": {
        "name": "Its name; default: scenario 1, 2, ...",
        "set": "Parameters of the model that are no design variables, with their values [SI]; of angles with a unit.",
        "options": "Other arguments of the model's function in this scenario.",
        "weight": "Its weight in means.",
    },
    "Setting": {
        "value": "One number, or a list.",
        "unit": "Its unit.",
    },
    "Combine": {
        "objective": "`worst`: the largest over the scenarios; `mean`: the weighted mean.",
        "constraints": "`each`: in every scenario; `worst`: the one nearest to its limit; `mean`: the weighted mean.",
    },
    "Optimizer": {
        "name": "Its name; more keys of this section are its options.",
        "max_iterations": "Iterations of each start at most.",
    },
    "Starts": {
        "sampler": "`sobol` or `latin_hypercube` points between the bounds, `given` points, or `none`: the first design alone.",
        "count": "Number of all starts, the first design among them.",
        "seed": "Seed of the points.",
        "include_initial": "Whether the design of the file is start 0.",
        "points": "The points of `given`: a list of numbers for each, in the units of `design`.",
    },
    "Range": {
        "from": "First value, in the unit of the variable.",
        "to": "Last value.",
        "count": "Number of values, ends included.",
    },
    "Tracking": {
        "experiment": "Name of the experiment in MLflow.",
        "uri": "The store; default: MLFLOW_TRACKING_URI, else ./mlflow.db.",
    },
}
