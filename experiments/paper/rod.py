"""Parts of section 5, the slider-crank: Tables 1-5, Figs. 4-11.

Everything is *inferred* where the lengths of the crank and the rod and the end time enter: they were fitted to the numbers of
Tables 2-4 (torchmbd/examples/slider_crank.py). Checked in tests/experiments/test_paper.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import torchmbd as mbd
from experiments.paper import figures4_7, figures8_11, table3, table4, table5
from experiments.paper.part import Part, Row

# c of eq. (37), Table 2: the largest 2U of the start design [J]
LIMITS = {1: 1.1572, 2: 0.8113, 3: 0.9841}
MODEL = "torchmbd.examples.slider_crank"
NOTES = {
    "bound": "a local minimum of the formulation (18)-(20)",
    "direct": "the peak itself",
    "bound from there": "the formulation (18)-(20) from the optimum of the peak itself",
}


def laminates(folder: Path, **options: Any) -> list[Row]:
    """Table 2: the limit of the peak energy, which is that of the start design."""
    rows = []
    for layers, (start, *_) in table3.PAPER.items():
        p = table3.problem(layers, start, **options)
        rows += [
            Row(f"L{layers}: start design (deg)", angles(start), angles(np.degrees(p.start)), "given"),
            Row(f"L{layers}: c of (37), peak of U (J)", LIMITS[layers] / 2, float(p.limits[0]), "inferred"),
        ]
    return rows


def least_integral(folder: Path, **options: Any) -> list[Row]:
    """Table 3."""
    rows = []
    for layers, (start, initial, optimum, reduction, layup) in table3.PAPER.items():
        result = mbd.optimize(table3.problem(layers, start, **options), method="mmfd")
        note = ""
        if layers == 3:
            note = "the printed optimum lies above the printed one of L1, which is a design of L3 too: a local minimum"
        rows += reduced(f"L{layers}: integral of U (J s)", (initial / 2, optimum / 2, reduction, layup), result, note)
    return rows


def least_peak(folder: Path, **options: Any) -> list[Row]:
    """Table 4: in the paper's formulation, and the peak itself."""
    rows = []
    for layers, (start, initial, optimum, reduction, layup, beta) in table4.PAPER.items():
        printed = (initial / 2, optimum / 2, reduction, layup)
        first, ends = float("nan"), {}
        for formulation in table4.OBJECTIVES:
            p = table4.problem(layers, start, formulation, **options)
            ends[formulation] = mbd.optimize(p, method="mmfd")
            first = float(mbd.Max(table4.ENERGY).value(p.motion(p.start))[0])
        ends["bound from there"] = table4.refined(layers, start, ends["direct"].x, **options)
        for name, result in ends.items():
            rows += reduced(f"L{layers}, {name}: peak of U (J)", printed, result, NOTES[name], first)
            if result.names[-1] == "bound":
                rows.append(Row(f"L{layers}, {name}: beta", beta, float(result.x[-1]), "inferred", NOTES[name]))
    return rows


def energy_and_torsion(folder: Path, **options: Any) -> list[Row]:
    """Table 5; nodes and normalization of the criteria are not printed."""
    rows = []
    for layers, (start, optimum, reduction, layup) in table5.PAPER.items():
        result = mbd.optimize(table5.problem(layers, start, "together", **options), method="mmfd")
        note = "normalization inferred; the paper's optimization ended in a local minimum" if layers == 1 else ""
        rows += reduced(f"L{layers}: weighted sum (1 at the start)", (1.0, optimum, reduction, layup), result, note)
    return rows


def reduced(
    what: str,
    printed: tuple[float, float, float, str],
    result: mbd.optimization.OptimizationResult,
    note: str = "",
    first: float | None = None,
) -> list[Row]:
    """Start, optimum, reduction [%] and design of an optimization beside the printed ones."""
    first = result.history[0].objective if first is None else first
    initial, optimum, reduction, layup = printed
    x = result.x[:-1] if result.names[-1] == "bound" else result.x
    return [
        Row(f"{what}, start", initial, first, "inferred"),
        Row(f"{what}, optimum", optimum, result.value, "inferred", note),
        Row(f"{what}, reduction (%)", reduction, 100.0 * (1.0 - result.value / first), "inferred"),
        Row(f"{what}, optimum (deg)", layup, angles(np.degrees(x)), "inferred", f"{result.analyses} analyses"),
    ]


def angles(degrees: Any) -> str:
    """A lay-up as the paper prints it."""
    return "/".join(f"{a:z.2f}".rstrip("0").rstrip(".") for a in degrees)


def sensitivities(folder: Path, cells: tuple[int, int], steps: int) -> list[Row]:
    """Table 1, Figs. 4-7: fixed against updated modes, direct differentiation against differences."""
    shown = figures4_7.figures(folder, cells, steps)
    rows = [Row("Table 1: lay-ups 1, 2, 6, 7 (deg)", "0, 15, 75, 90", layups(), "given")]
    for layup, angle in ((1, "0 deg"), (7, "90 deg")):
        missed = float(shown[f"layup_{layup}_edge_fixed_minus_updated"])
        share = 100.0 * missed / float(shown["layup_1_edge_sensitivity"])
        rows.append(Row(f"fixed modes are off at {angle}, % of the largest at 0 deg", None, share, "inferred"))
    rows.append(
        Row("fixed and updated modes", "agree for one lay-up", "for 90 deg", "inferred", "at the scale of Fig. 4")
    )
    for layup, angle in ((2, "15 deg"), (6, "75 deg")):
        errors = [float(x) for name, x in shown.items() if name.startswith(f"layup_{layup}_step_")]
        result = f"{min(errors):.1g} to {max(errors):.1g}"
        rows.append(Row(f"errors of forward differences at {angle}", "depend on the step", result, "inferred"))
    return rows


def layups() -> str:
    """The lay-ups of Table 1 as text."""
    return ", ".join(f"{a:g}" for a in figures4_7.LAYUPS.values())


def criteria(folder: Path, **options: Any) -> list[Row]:
    """Figs. 8-11."""
    shown: Mapping[str, float | str] = figures8_11.figures(folder, **options)
    return [
        Row("Fig. 8: minima over the angle", "one, at 0 deg", str(shown["figure8_minima"]), "inferred"),
        Row("Fig. 9: peak of U, start (J)", 0.984053 / 2, float(shown["figure9_peak_start_design"]), "inferred"),
        Row("Fig. 9: peak of U, least peak (J)", 0.176677 / 2, float(shown["figure9_peak_least_peak"]), "inferred"),
        Row("Fig. 9: peak of U, least integral (J)", None, float(shown["figure9_peak_least_integral"]), "inferred"),
        Row("Fig. 10: integral of 2U at the end", None, float(shown["figure10_integral_of_2U"]), "inferred"),
        Row("Fig. 11: local minimum near 45 deg", "49.2 (0.979)", str(shown["figure11_minima"]), "inferred"),
    ]


_MESH = {"cells": (24, 4), "steps": 600}
PARTS = (
    Part("figures4_7", "Table 1, Figs. 4-7: sensitivities", sensitivities, (MODEL, "experiments.paper.figures4_7"), 0.5,
         {"cells": (12, 2), "steps": 300}),
    Part("table2", "Table 2: laminates of the rod", laminates, (MODEL, "experiments.paper.table3"), 0.2, _MESH),
    Part("table3", "Table 3: least integral of energy", least_integral, (MODEL, "experiments.paper.table3"), 2.0, _MESH),
    Part("table4", "Table 4: least peak of energy", least_peak, (MODEL, "experiments.paper.table4"), 6.0, _MESH),
    Part("table5", "Table 5: energy and torsion", energy_and_torsion, (MODEL, "experiments.paper.table5"), 2.0, _MESH),
    Part("figures8_11", "Figs. 8-11: criteria over angle, time and iterations", criteria,
         (MODEL, *(f"experiments.paper.{x}" for x in ("figures8_11", "table3", "table4", "table5"))), 3.0, _MESH),
)  # fmt: skip
