"""Anomalies: sensors that do not behave as their model, one by one and together, at a set false-alarm rate."""

from twin_core.anomaly.discoveries import adjusted, discoveries
from twin_core.anomaly.hysteresis import Interval
from twin_core.anomaly.thresholds import Thresholds

__all__ = ["Interval", "Thresholds", "adjusted", "discoveries"]
