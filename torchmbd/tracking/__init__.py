"""Tracking of studies: the contract, and MLflow behind it. Nothing below this floor knows of it."""

from torchmbd.tracking.process import ProcessTracker
from torchmbd.tracking.tracker import Record, Status, Tracker, TrackingError

__all__ = ["ProcessTracker", "Record", "Status", "Tracker", "TrackingError"]
