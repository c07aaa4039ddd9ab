"""The live state: assimilation of what arrives, and forecasts from there."""
