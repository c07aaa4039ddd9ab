"""Calibration: fitting a declared network to measured temperatures."""
