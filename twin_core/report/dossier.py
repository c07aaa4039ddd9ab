"""What a signature asks for beyond the verdict: which parameter moves what, where heat flows, what the figures rest on."""

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from twin_core import __version__
from twin_core._typing import FloatArray, Json
from twin_core.calibrate.result import CalibratedModel
from twin_core.calibrate.second_order import Calibration
from twin_core.calibrate.statistics import spread_of
from twin_core.discover.judge import Search
from twin_core.errors import TelemetryError
from twin_core.flows import flows_along
from twin_core.holdout import Prediction
from twin_core.network.dynamics import fill_boundaries
from twin_core.network.spec import TwinSpec
from twin_core.network.spec_io import dump_spec
from twin_core.parameters.transforms import is_logarithmic
from twin_core.telemetry import Record

CHANGE = 0.1
"""Relative change of a parameter whose effect on the readings is told; a temperature is changed by 1 K instead."""
MOST_LINKS = 200
"""Couplings whose heat a report lists."""
LIBRARIES = ("numpy", "scipy", "numba")


def ensemble(spec: TwinSpec, per_sensor: Mapping[str, Json], predictions: Sequence[Prediction]) -> Json:
    """Return the figures of all sensors together.

    Parameters
    ----------
    spec
        Declares the limits.
    per_sensor
        Scores of each sensor, with ``met``.
    predictions
        What they were made of.

    Returns
    -------
    dict
        As ``statistics.spread_of``, and ``rmse_K``, ``readings``, ``share_within`` (of the readings, within the sensor's own
        limit for 99 % of them), ``sensors`` and ``sensors_met``.
    """
    deviation = np.concatenate([p.measured_K - p.predicted_K for p in predictions])
    limits = np.array([spec.criteria.of(sensor)["q99_abs_K"] for sensor in spec.sensors])
    known = np.isfinite(deviation)
    if not known.any():
        return {}
    finite = deviation[known]
    return {
        **spread_of(finite),
        "rmse_K": float(np.sqrt(np.mean(finite**2))),
        "readings": int(finite.size),
        "share_within": float((np.abs(deviation) <= limits)[known].mean()),
        "sensors": len(per_sensor),
        "sensors_met": sum(bool(row["met"]) for row in per_sensor.values()),
    }


def sensitivity(calibration: Calibration) -> Json:
    """Return which parameter moves which sensor over the training part, open loop and to first order.

    Returns
    -------
    dict
        ``sensors``; and ``rows``, one per free parameter: ``parameter``, ``change`` in words, and ``rms_K``, the root mean
        square by which each sensor's predicted readings then move.
    """
    problem, optimum = calibration.problem, calibration.optimum
    total, count = np.zeros((problem.n_free, len(problem.network.spec.sensors))), 0
    for _, _, block in problem.jacobian_stretches(optimum.unknowns, optimum.fit):
        total += (block[:, :, : problem.n_free] ** 2).sum(axis=0).T
        count += block.shape[0]
    slopes_K = np.sqrt(total / max(count, 1))
    rows = []
    parameters = calibration.network.parameters
    for position, index in enumerate(parameters.free_index):
        parameter = parameters.parameters[int(index)]
        if is_logarithmic(parameter.transform):
            step, change = float(np.log1p(CHANGE)), f"+{CHANGE:.0%}"
        else:
            change_by = 1.0 if parameter.unit == "K" else CHANGE * abs(parameter.value)
            step = change_by / max(float(parameter.transform.slope(parameter.free)), 1e-300)
            change = "+1 K" if parameter.unit == "K" else f"+{CHANGE:.0%}"
        rows.append({"parameter": parameter.name, "change": change, "rms_K": (step * slopes_K[position]).tolist()})
    return {"sensors": list(problem.network.spec.sensors), "rows": rows}


Moment = tuple[str | float, str | float]
"""Begin and end of a phase in the telemetry's own form; an instant where both are the same."""


def check_moments(records: Sequence[Record], moments: Sequence[Moment]) -> None:
    """Refuse moments that do not lie within one record; TelemetryError names the first."""
    for start, stop in moments:
        inside = False
        for record in records:
            if record.epoch_ns is not None and not (isinstance(start, str) and isinstance(stop, str)):
                raise TelemetryError(f"heat flows at {start}: {record.name} is dated; write a date")
            first_s, last_s = record.locate_s(start), record.locate_s(stop)
            inside |= record.time_s[0] <= first_s <= last_s <= record.time_s[-1]
        if not inside:
            spans = ", ".join(f"{r.present(r.time_s[0])} to {r.present(r.time_s[-1])}" for r in records)
            said = f"{start}" if start == stop else f"{start} to {stop}"
            raise TelemetryError(f"heat flows at {said}: no segment of the training telemetry holds it ({spans})")


def heat_flow_maps(search: Search, after: CalibratedModel, moments: Sequence[Moment] = ()) -> list[Json]:
    """Return the heat flows of the corrected model at moments of the training telemetry, or else of its last segment.

    Without ``moments``: on average over the last segment, at its hottest and at its coldest. Each map is what
    ``flows.flows_along`` returns, the largest links first and those beyond ``MOST_LINKS`` only counted, with ``phase`` in
    words and ``start`` and ``stop`` in the telemetry's own form.
    """
    calibration = search.trial.calibration()
    segments = calibration.problem.segments
    if not np.isfinite(calibration.optimum.fit.trajectories[-1].stages_K).all():
        return []
    spans = [span for moment in moments for span in _spans_of(calibration, moment)]
    if not moments:
        last = len(segments) - 1
        stages = calibration.optimum.fit.trajectories[last].stages_K
        sensed = stages[:, 1, calibration.network.sensor_node].mean(axis=1)
        spans = [("on average over the last training segment", last, 0, segments[last].forcing.n_steps)]
        for words, step in (("hottest moment", int(sensed.argmax())), ("coldest moment", int(sensed.argmin()))):
            spans.append((f"{words} of it, by the mean of the sensors", last, step, step + 1))
    return [_map(calibration, after, *span) for span in spans]


def _spans_of(calibration: Calibration, moment: Moment) -> Iterator[tuple[str, int, int, int]]:
    """Yield the segment of a moment and its steps, the first of them and the one after the last."""
    start, stop = moment
    for number, segment in enumerate(calibration.problem.segments):
        begin_s, end_s = segment.record.locate_s(start), segment.record.locate_s(stop)
        if not segment.record.time_s[0] <= begin_s <= end_s <= segment.record.time_s[-1]:
            continue
        ends_s = segment.forcing.stage_time_s[:, 1]
        first = min(int(np.searchsorted(ends_s, begin_s, side="right")), ends_s.size - 1)
        last = max(first, min(int(np.searchsorted(ends_s, end_s)), ends_s.size - 1))
        yield ("chosen moment" if start == stop else "on average over the chosen phase"), number, first, last + 1
        return


def _map(calibration: Calibration, after: CalibratedModel, words: str, number: int, first: int, last: int) -> Json:
    """Return the flows over steps of a segment."""
    network, segment = calibration.network, calibration.problem.segments[number]
    forcing, stages = segment.forcing, calibration.optimum.fit.trajectories[number].stages_K
    boundaries = fill_boundaries(network, network.parameters.values, forcing.boundaries_flat_K(first, last))
    along = forcing.along(stages[first:last].reshape(-1, stages.shape[2]), boundaries, first, last)
    start = forcing.stage_time_s[first, 0]
    stop = forcing.stage_time_s[last - 1, 1] if last - first > 1 else start
    told = {"phase": words, "start": segment.record.present(start), "stop": segment.record.present(stop)}
    flows = flows_along(after, network, along, np.repeat(forcing.step_s[first:last], 2))
    flows["links"].sort(key=lambda link: -abs(link["heat_W"]))
    told["links_left_out"] = max(len(flows["links"]) - MOST_LINKS, 0)
    return told | flows | {"links": flows["links"][:MOST_LINKS]}


def left_out(spec: TwinSpec) -> list[Json]:
    """Return the intervals that the specification excludes, with their reasons."""
    return [{"start": i.start, "stop": i.stop, "reason": i.reason} for i in spec.exclude]


def provenance(spec: TwinSpec, records: Sequence[Record]) -> Json:
    """Return what the figures rest on: hashes of specification and telemetry, and the versions that made them.

    The specification's is the SHA-256 of its JSON with sorted keys and no spaces; that of telemetry is over the seconds and,
    channel by channel in the order of their names, over the name and the values in SI, little-endian doubles, as they were
    used: a masked sample is NaN.
    """
    text = json.dumps(dump_spec(spec), sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    versions = {"thermal-twin": __version__, "python": platform.python_version()}
    for library in LIBRARIES:
        try:
            versions[library] = version(library)
        except PackageNotFoundError:  # installed in a form that carries no metadata
            continue
    return {
        "specification_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "telemetry": [
            {
                "name": record.name,
                "start": record.present(record.time_s[0]),
                "stop": record.present(record.time_s[-1]),
                "samples": int(record.time_s.size),
                "sha256": _hash(record),
            }
            for record in records
        ],
        "versions": versions,
    }


def _hash(record: Record) -> str:
    digest = hashlib.sha256(_bytes(record.clock_s))
    for name in sorted(record.values):
        digest.update(name.encode())
        digest.update(_bytes(record.values[name]))
    return digest.hexdigest()


def _bytes(values: FloatArray) -> bytes:
    """Return little-endian doubles; every NaN is the same."""
    return np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes()


def histograms(spec: TwinSpec, predictions: tuple[Sequence[Prediction], Sequence[Prediction]], bins: int = 40) -> Json:
    """Return counts of the held-out deviations of each sensor before and after, in bins that both share."""
    found: dict[str, Any] = {}
    both = [np.concatenate([p.measured_K - p.predicted_K for p in ps]) for ps in predictions]
    for i, sensor in enumerate(spec.sensors):
        columns = [table[:, i][np.isfinite(table[:, i])] for table in both]
        if not all(column.size for column in columns):
            continue
        low, high = (f([f(column) for column in columns]) for f in (min, max))
        edges = np.linspace(low, high if high > low else low + 1e-9, bins + 1)
        before, after = (np.histogram(column, edges)[0].tolist() for column in columns)
        found[sensor] = {"edges_K": edges.tolist(), "before": before, "after": after}
    return found


def limits(spec: TwinSpec, noise_K: Mapping[str, float]) -> Json:
    """Return noise and acceptance limits of each sensor, for its plots."""
    return {sensor: {"noise_K": noise_K[sensor], **spec.criteria.of(sensor)} for sensor in spec.sensors}
