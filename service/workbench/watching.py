"""The search for anomalies in what a filter says. Runs in worker processes only: it is compiled."""

from dataclasses import replace

import numpy as np

from service.workbench.interface import Filtered, Stretch


def watched(stretch: Stretch, filtered: Filtered) -> Filtered:
    """Return a filtered stretch with the anomalies of its newest samples; as it is where nobody wants to know."""
    watch = stretch.watch
    if watch is None:
        return filtered
    from twin_core.anomaly.detect import detect

    readings = np.stack([watch.readings[sensor] for sensor in filtered.sensors], axis=1)
    new = slice(stretch.telemetry.time_us.size - readings.shape[0], None)
    residuals = (filtered.innovation_K[new], filtered.innovation_std_K[new], filtered.nis[new])
    instants = stretch.telemetry.time_us[new]
    state, intervals = detect(watch.state, filtered.sensors, instants, readings, *residuals, watch.thresholds)
    return replace(filtered, watch=state, intervals=tuple(intervals))
