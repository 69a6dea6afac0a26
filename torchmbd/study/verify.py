"""The end of a study: its best design is verified in a finer model before it is reported (design/verification.py).

Checked in tests/study/test_verification.py.
"""

from __future__ import annotations

from typing import Any

from rich.console import Console

from torchmbd.design import Problem
from torchmbd.design.verification import other_ends, verification
from torchmbd.optimization import MultistartResult
from torchmbd.progress import begin_stage
from torchmbd.results.answer import Verification
from torchmbd.study.answers import print_answers
from torchmbd.study.journal import Journal
from torchmbd.study.settings import StudySettings


def verify_best(
    study: StudySettings, best: Any, searches: MultistartResult | None, journal: Journal, console: Console
) -> Verification | None:
    """Verify the best design of a study, print and file it; None where nothing is simulated.

    searches  the ends of the starts, among which it is the best; None: it is on the steps of its variables
    """
    if not isinstance(study.simulated, Problem):
        return None
    begin_stage("verifying start and best design with half the steps and more modes")
    others = [] if searches is None else other_ends(searches)
    result = verification(study.problem, best.x, best.value, others, study.points[0], study.feasibility)
    journal.verified(result)
    print_answers(result, console)
    return result
