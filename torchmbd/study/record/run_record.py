"""What is kept of a run of a study: its runs in the tracking store and its state on disk, with one owner.

The runs are in the store before the state says so (unfinished.py), and at the end the terminal says where they are.
Checked in tests/study/test_run.py, test_resume.py, test_figures.py.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError
from torchmbd.results.answer import MANY_FAILURES, NOT_VERIFIED
from torchmbd.study.record.runs import PARENT
from torchmbd.study.record.unfinished import StudyState, claim_study, unsent
from torchmbd.study.report.listing import print_links_of, study_links
from torchmbd.tracking import MlflowTracker, Record, Status, TrackingError
from torchmbd.tracking.catalog import VERIFICATION, find
from torchmbd.tracking.links import DEFAULT_BASE
from torchmbd.tracking.store import own_files, store_uri
from torchmbd.tracking.uri import StoreURI

EXIT: dict[Status, int] = {"FINISHED": 0, "FAILED": 1, "KILLED": 130}
UNVERIFIED = 3  # exit code of a study that is finished, and whose best design does not hold in a finer model (cli.py)


class RunRecord:
    """The runs of a study and its state; made by `opened`.

    name, kind   of the study
    console      where it says what is kept
    make         makes the tracker of the runs, when the first of them begins
    state, store  on disk, and of the runs; None: the caller has made the tracker, and no other process continues its runs
    """

    def __init__(
        self,
        name: str,
        kind: str,
        console: Console,
        make: Callable[[], MlflowTracker],
        state: StudyState | None = None,
        store: StoreURI | None = None,
    ) -> None:
        self.name, self.kind, self.console, self.state, self.store = name, kind, console, state, store
        self.stored: Record | None = None  # the runs in the store, when all are there
        self.status: Status = "FAILED"
        self._make = make

    @classmethod
    @contextmanager
    def opened(
        cls,
        name: str,
        kind: str,
        console: Console,
        key: Callable[[StoreURI], str],
        origin: tuple[Path | None, Sequence[str]],
        runs: tuple[str, str | StoreURI | None],
        tracker: MlflowTracker | None = None,
        fresh: bool = False,
    ) -> Iterator[Self]:
        """The record of a study that this process runs: no other process can run it at the same time.

        key      store -> hash by which the study is continued
        origin   experiment file with its overrides; None: made in Python
        runs     experiment of MLflow, and its store
        tracker  of the runs; None: one for the store, in which the runs of an earlier process go on
        fresh    begin other runs
        """
        if tracker is not None:
            yield cls(name, kind, console, lambda: tracker)
            return
        experiment, store = runs[0], store_uri(runs[1])
        with claim_study(key(store), name, *origin, store, fresh) as state:
            # The tracker is made later: `finished_run` may give the state another id.
            yield cls(name, kind, console, lambda: MlflowTracker(experiment, store, state.id), state, store)

    @cached_property
    def tracker(self) -> MlflowTracker:
        return self._make()

    @property
    def run_id(self) -> str | None:
        """The run of the whole study; None: it has not reached the store."""
        return None if self.stored is None else self.stored.runs.get(PARENT)

    def tell_finished(self, designs: str, **options: Any) -> int | None:
        """Print where the run of a study is that has finished earlier, and return the exit code.

        None if it has not finished, or if its store has lost the run.

        designs  where its designs are: a command, or a file; "{run}": the beginning of its run id
        options  of the command that runs it anew
        """
        if self.state is None or self.store is None or not self.state.run_id:
            return None
        try:
            entry = find(self.store, self.state.run_id)
        except InputError:
            self.state.renew()
            return None
        best = entry.metrics.get("best_objective")
        outcome = "" if best is None else f", best objective {best:.6g}"
        say = partial(self.console.print, soft_wrap=True, highlight=False, markup=False)
        say(f"{self.name}: finished on {self.state.ended}{outcome}; nothing is run again")
        self._print_links(Record(self.store, entry.experiment_id, {PARENT: entry.run_id}), entry.kind, "FINISHED")
        verified = entry.tags.get(VERIFICATION, "")
        if verified:
            say(verified)
        again = self.state.command(**options, fresh=True)
        say(f"its designs: {designs.format(run=entry.run_id[:8])}; to run it anew: {again}")
        return UNVERIFIED if verified.startswith((NOT_VERIFIED, MANY_FAILURES)) else EXIT["FINISHED"]

    def carry_out(self, run: Callable[[], Status], trouble: Callable[[], str | None] = lambda: None) -> None:
        """Call `run`, and bring its runs to an end in the store, however it ends; `status` says how.

        run      the study: it returns how it ended; Ctrl-C ends it as KILLED, another exception, which is raised, as FAILED
        trouble  returns why the last evaluations are not on disk, None if they are
        """
        try:
            self.status = run()
        except KeyboardInterrupt:
            self.status = "KILLED"
        finally:
            self.tracker.end_all(self.status)
            self._close(trouble())

    def _close(self, trouble: str | None) -> None:
        """Wait until everything is in the store, and note it; a message if the tracker gives up."""
        say = partial(self.console.print, style="red", soft_wrap=True)
        try:
            with self.console.status("writing the last of it to MLflow"):
                self.stored = self.tracker.close()
        except TrackingError as error:
            say(f"Tracking failed: {escape(str(error))}")
        if trouble:
            again = ". When both take them, the same command makes them again and sends the study"
            say(f"The last evaluations are not on disk: {escape(trouble)}{'' if self.stored else again}")
        elif self.stored is None and self.tracker.trouble:
            say("When the store takes them, `torchmbd sync` sends the study: what it has computed is on disk")
        if self.stored is not None and self.state is not None:
            if self.stored.runs:
                self.state.mark_sent()
            else:  # no run has begun
                self.state.forget()

    def tell_outcome(self, known: str = "", **options: Any) -> int:
        """Print how the study ended and where its run is, update its state on disk, and return the exit code.

        known    of its evaluations, in words
        options  of the command that goes on with it
        """
        status = self.status
        after = f"{status.lower()} after {self.tracker.seconds:.1f} s{known}"
        self.console.print(f"{escape(self.name)}: {after}", soft_wrap=True)
        if self.stored is None:
            return 1
        if self.run_id is not None:
            self._print_links(self.stored, self.kind, status)
        if status == "KILLED" and self.state is not None:
            again = f"to go on with it: {self.state.command(**options)}"
            self.console.print(again, soft_wrap=True, highlight=False, markup=False)
        if status == "FINISHED" and self.state is not None:
            if self.kind == "figures":  # their function may draw other figures the next time
                self.state.forget()
            else:
                self.state.mark_finished(self.stored.runs[PARENT])
        if waiting := unsent():
            text = f"{len(waiting)} earlier studies are not in their tracking store: torchmbd sync"
            self.console.print(text, soft_wrap=True)
        return EXIT[status]

    def _print_links(self, record: Record, kind: str, status: Status) -> None:
        run = record.runs[PARENT]
        base = record.uri.page if record.uri.served else DEFAULT_BASE
        links = study_links(base, record.experiment_id, run, kind, status)
        if folder := own_files(record.uri, run):
            self.console.print("To look at it: torchmbd ui, then", highlight=False)
            links["on disk"] = os.path.relpath(folder) if folder.is_relative_to(Path.cwd()) else str(folder)
        print_links_of(links, self.console)
