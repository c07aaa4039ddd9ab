"""The service: telemetry in; state, forecasts, anomalies, better models and a dashboard out."""
