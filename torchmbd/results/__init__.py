"""Motions and what is read from them: functions of plain motion data."""
