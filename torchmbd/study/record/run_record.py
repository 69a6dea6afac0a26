"""The record of a run: its runs in the tracking store, their files, and its state on disk.

The runs are in the store before the state says so (unfinished.py), and at the end the terminal says where they are.
Checked in tests/study/test_run.py, test_figures.py, tests/study/record/test_resume.py, test_journal.py, test_disks.py.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from rich.markup import escape

from torchmbd.errors import InputError
from torchmbd.results.answer import MANY_FAILURES, NOT_VERIFIED
from torchmbd.study.file.yaml_file import without_user
from torchmbd.study.record.metric_names import legal_key
from torchmbd.study.record.unfinished import PARENT, Experiment, StudyState, claim_study, unsent
from torchmbd.study.report.listing import print_links_of, study_links
from torchmbd.tracking import MlflowTracker, Record, Status, TrackingError
from torchmbd.tracking.catalog import VERIFICATION, find
from torchmbd.tracking.links import DEFAULT_BASE
from torchmbd.tracking.provenance import provenance
from torchmbd.tracking.store import own_files, relative_to_store, store_uri
from torchmbd.tracking.uri import StoreURI, hidden

EXIT: dict[Status, int] = {"FINISHED": 0, "FAILED": 1, "KILLED": 130}
UNVERIFIED = 3  # exit code of a study that is finished, and whose best design does not hold in a finer model (cli.py)


class RunRecord:
    """The runs of an experiment in the tracking store, a parent and a child for each start or point, with their files.

    experiment  what is run
    console     where it says what is kept
    tracker     of the runs; None: one for the store, in which the runs of an earlier process go on
    uri         the store; None: that of the experiment
    """

    def __init__(
        self,
        experiment: Experiment,
        console: Console,
        tracker: MlflowTracker | None = None,
        uri: str | StoreURI | None = None,
    ) -> None:
        self.experiment, self.console = experiment, console
        self.store = None if tracker is not None else store_uri(uri or experiment.uri)
        self.state: StudyState | None = None  # on disk; None: the caller has made the tracker
        self.stored: Record | None = None  # the runs in the store, when all are there
        self.status: Status = "FAILED"
        self._tracker, self._missing = tracker, ""

    @contextmanager
    def claimed(self, fresh: bool = False) -> Iterator[None]:
        """Within the block no other process can run the experiment; `fresh`: begin other runs than an earlier process."""
        if self.store is None:
            yield
            return
        with claim_study(self.experiment, self.store, fresh) as self.state:
            yield

    @property
    def tracker(self) -> MlflowTracker:
        if self._tracker is None:
            assert self.store is not None
            assert self.state is not None
            experiment = self.experiment.experiment
            self._tracker = MlflowTracker(experiment, self.store, self.state.id, self.state.folder)
        return self._tracker

    @property
    def folder(self) -> Path:
        """The folder in which files are written before the tracker takes them."""
        return self.tracker.files

    def begin(self, tags: Mapping[str, str]) -> None:
        """Open the parent; its tags say where the experiment comes from, its files are the experiment file as it was read."""
        experiment, file = self.experiment, self.experiment.file
        folder = Path() if file is None else file.absolute().parent
        origin = {"kind": experiment.kind, **tags, **provenance(folder)}
        if experiment.question:
            origin["question"] = origin["mlflow.note.content"] = experiment.question
        if file is not None:
            origin["mlflow.source.name"] = relative_to_store(self.tracker.uri, file)
            origin |= {"overrides": hidden(" ".join(experiment.overrides))} if experiment.overrides else {}
        resolved = experiment.resolved()
        self.tracker.begin(PARENT, experiment.name, params=flat(resolved), tags=origin)
        self.text("config.yaml", yaml.safe_dump(resolved, sort_keys=False))
        if file is not None and file.is_file():
            self.text("config_as_given.yaml", without_user(file.read_text(encoding="utf-8")))

    def begin_child(self, index: int, kind: str, params: Mapping[str, object] = {}) -> None:
        """Open the child of a start or a point."""
        name = f"{kind} {index}"
        self.tracker.begin(child(index), name, parent=PARENT, params={kind: index, **params}, tags={"kind": kind})

    def text(self, name: str, content: str) -> None:
        """Write a text file as an artifact; a full disk loses the file, not the study."""
        try:
            (self.folder / name).write_text(content, encoding="utf-8")
        except OSError as error:
            self._missing = f"{name} cannot be written: {error.strerror}"
        else:
            self.file(self.folder / name)

    def file(self, path: Path, folder: str = "") -> None:
        """Make a file an artifact of the parent."""
        self.tracker.artifact(PARENT, path, folder)

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
        say(f"{self.experiment.name}: finished on {self.state.ended}{outcome}; nothing is run again")
        self._print_links(self.store, entry.experiment_id, entry.run_id, "FINISHED")
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
        if self.stored is not None and not self.stored.runs and self.state is not None:  # no run has begun
            self.state.forget()

    def tell_outcome(self, known: str = "", **options: Any) -> int:
        """Print how the study ended and where its run is, update its state on disk, and return the exit code.

        known    of its evaluations, in words
        options  of the command that goes on with it
        """
        status = self.status
        if self._missing:
            self.console.print(f"A file is missing: {escape(self._missing)}", style="red", soft_wrap=True)
        after = f"{status.lower()} after {self.tracker.seconds:.1f} s{known}"
        self.console.print(f"{escape(self.experiment.name)}: {after}", soft_wrap=True)
        if self.stored is None:
            return 1
        if self.run_id is not None:
            self._print_links(self.tracker.uri, self.stored.experiment_id, self.run_id, status)
        if status == "KILLED" and self.state is not None:
            again = f"to go on with it: {self.state.command(**options)}"
            self.console.print(again, soft_wrap=True, highlight=False, markup=False)
        if status == "FINISHED" and self.state is not None:
            if self.experiment.kind == "figures":  # their function may draw other figures the next time
                self.state.forget()
            else:
                self.state.mark_finished(self.stored.runs[PARENT])
        if waiting := list(unsent()):
            text = f"{len(waiting)} earlier studies are not in their tracking store: torchmbd sync"
            self.console.print(text, soft_wrap=True)
        return EXIT[status]

    def _print_links(self, uri: StoreURI, experiment_id: str, run: str, status: Status) -> None:
        base = uri.page if uri.served else DEFAULT_BASE
        links = study_links(base, experiment_id, run, self.experiment.kind, status)
        if folder := own_files(uri, run):
            self.console.print("To look at it: torchmbd ui, then", highlight=False)
            links["on disk"] = os.path.relpath(folder) if folder.is_relative_to(Path.cwd()) else str(folder)
        print_links_of(links, self.console)


def child(index: int) -> str:
    """Return the tracker's key of a start."""
    return f"start_{index}"


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    """Flatten nested mappings, and lists of them, to dotted keys: `optimizer.name`, `subject_to.0.at_most`."""
    result: dict[str, object] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            result |= flat(value, f"{prefix}{key}.")
        elif isinstance(value, (list, tuple)) and any(isinstance(entry, Mapping) for entry in value):
            result |= flat({str(k): entry for k, entry in enumerate(value)}, f"{prefix}{key}.")
        else:
            result[legal_key(f"{prefix}{key}")] = value
    return result
