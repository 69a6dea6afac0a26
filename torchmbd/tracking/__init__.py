"""Tracking of studies by MLflow. Nothing below this floor knows of it."""

from torchmbd.tracking.mlflow_tracker import MlflowTracker
from torchmbd.tracking.tracker import Record, Status, TrackingError

__all__ = ["MlflowTracker", "Record", "Status", "TrackingError"]
