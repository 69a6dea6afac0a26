"""Tracking of studies by MLflow; only torchmbd.study and the command line use it."""

from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.store import Status, TrackingError
from torchmbd.tracking.writer import Record

__all__ = ["MlflowTracker", "Record", "Status", "TrackingError"]
