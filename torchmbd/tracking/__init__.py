"""Tracking of studies by MLflow; only torchmbd.study and the command line use it."""

from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.tracker import Record, Status, TrackingError

__all__ = ["MlflowTracker", "Record", "Status", "TrackingError"]
