"""`torchmbd sync`: send studies to a tracking store that could not be reached, or that were killed before they were sent.

A study is run again from its file with the evaluations on disk; at the first design that is not on disk it ends as after
Ctrl-C. So the store gets the same runs as from the study itself. Figures are drawn again.
Checked in tests/study/record/test_unfinished.py.
"""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from torchmbd.errors import MbdError
from torchmbd.study.file.load import load
from torchmbd.study.record.unfinished import StudyState, unsent
from torchmbd.tracking.store import open_store, store_uri
from torchmbd.tracking.uri import StoreURI


def send_unsent(console: Console) -> int:
    """Send every study that is not in its store; return the number of those that could not be sent."""
    waiting = 0
    studies = unsent()
    for study in studies:
        try:
            name = _send(study)
        except (MbdError, OSError) as error:
            console.print(
                f"{study.path or study.name} is not in {study.uri}: {escape(str(error))}", style="red", soft_wrap=True
            )
            waiting += 1
        else:
            console.print(f"{name}: in {study.uri}", soft_wrap=True)
    if not waiting:
        console.print("everything is in its tracking store")
    return waiting


def _send(study: StudyState) -> str:
    """Send one study and return its name; MbdError if it cannot be sent."""
    if study.path is None:
        raise MbdError("it was made in Python; allowed: run its script again, which sends it")
    kind, experiment = load(study.path, study.overrides)
    uri = _store(study, experiment.uri)
    if kind.key(experiment, uri) != study.folder.name:
        raise MbdError(
            f"the file, its model or torchmbd has changed since; allowed: torchmbd run, which begins it anew, "
            f"or remove {study.folder}"
        )
    open_store(uri)
    kind.run(experiment, Console(quiet=True), uri=uri, offline=True)
    if any(other.folder == study.folder for other in unsent()):
        raise MbdError("the store has not taken all of it; allowed: torchmbd sync, when it is back")
    return study.name


def _store(study: StudyState, file_uri: StoreURI | None) -> StoreURI:
    """Return the URI of a study's store, its user part from the experiment file (`file_uri`) or the environment."""
    if not study.uri.masked:
        return study.uri
    whole = store_uri(None if file_uri is None or file_uri.masked else file_uri)
    if str(whole) != str(study.uri):
        raise MbdError("its user and password are on no disk; allowed: the whole URI as MLFLOW_TRACKING_URI")
    return whole
