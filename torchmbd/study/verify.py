"""The end of a study: its best design is verified in a finer model before it is reported (design/verification.py).

Checked in tests/study/test_verification.py.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.verification import other_ends, verification
from torchmbd.optimization import MultistartResult, RobustProblem
from torchmbd.optimization.cache import CachedProblem
from torchmbd.progress import begin_stage
from torchmbd.results.answer import Verification
from torchmbd.study.record.journal import Journal
from torchmbd.study.report.answers import print_answers
from torchmbd.study.settings import StudySettings


def verify_best(
    study: StudySettings, best: Any, outcome: MultistartResult, is_among: bool, journal: Journal, console: Console
) -> Verification | None:
    """Verify the best design of a study, print and file it; None where nothing is simulated.

    outcome   the ends of the starts
    is_among  whether the design is one of them; else it is on the steps of its variables
    """
    if not isinstance(study.simulated, Problem):
        return None
    begin_stage("verifying start and best design with half the steps, more modes and finer meshes")
    others = other_ends(outcome) if is_among else []
    problem = study.problem if outcome.best is None else evaluated_problem(outcome.best.problem)
    result = verification(problem, best.x, best.value, others, study.points[0], study.feasibility)
    result = replace(result, search=outcome.search_text, failing=outcome.failing_text)
    journal.verified(result)
    print_answers(result, console)
    return result


def evaluated_problem(problem: Any) -> Any:
    """The problem by the steps at which a search ended, without the store of its evaluations."""
    if isinstance(problem, RobustProblem):
        return problem.over(evaluated_problem(problem.problem))
    return problem.problem if isinstance(problem, CachedProblem) else problem
