"""Bridges to the products of a control room: telemetry comes from there, forecasts and residuals go back there."""
