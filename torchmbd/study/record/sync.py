"""`torchmbd sync`: send the journals of studies whose store could not be reached, or that were killed before they were sent.

Nothing is computed, and no model is executed: the journal of a study is the record of its runs.
Checked in tests/study/record/test_unfinished.py.
"""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape

from torchmbd.errors import MbdError
from torchmbd.study.file.yaml_file import read_yaml
from torchmbd.study.record.unfinished import PARENT, StudyState, unsent
from torchmbd.tracking import MlflowTracker
from torchmbd.tracking.store import open_store, store_uri
from torchmbd.tracking.uri import StoreURI


def send_unsent(console: Console) -> int:
    """Send every study that is not in its store; return the number of those that could not be sent."""
    waiting = 0
    for study in unsent():
        try:
            _send(study)
        except (MbdError, OSError) as error:
            console.print(
                f"{study.path or study.name} is not in {study.uri}: {escape(str(error))}", style="red", soft_wrap=True
            )
            waiting += 1
        else:
            console.print(f"{study.name}: in {study.uri}", soft_wrap=True)
    if not waiting:
        console.print("everything is in its tracking store")
    return waiting


def _send(study: StudyState) -> None:
    """Send one study; MbdError if it cannot be sent."""
    uri = _store(study)
    open_store(uri)
    tracker = MlflowTracker.left(study.experiment, uri, study.id, study.folder)
    record = tracker.close()
    if tracker.statuses.get(PARENT) == "FINISHED":
        study.mark_finished(record.runs[PARENT])


def _store(study: StudyState) -> StoreURI:
    """Return the URI of a study's store, its user part from the experiment file or the environment."""
    if not study.uri.masked:
        return study.uri
    tracking = read_yaml(study.path).data.get("tracking", {}) if study.path is not None else {}
    named = StoreURI(tracking["uri"]) if "uri" in tracking else None
    whole = named if named is not None and str(named) == str(study.uri) else store_uri()
    if str(whole) != str(study.uri):
        raise MbdError("its user and password are on no disk. Try: the whole URI as MLFLOW_TRACKING_URI")
    return whole
