"""Tracking of studies: the contract, and MLflow behind it. Nothing below this floor knows of it."""

from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.tracker import Record, Status, Tracker, TrackingError

__all__ = ["MlflowTracker", "Record", "Status", "Tracker", "TrackingError"]
