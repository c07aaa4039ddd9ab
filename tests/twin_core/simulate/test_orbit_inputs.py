"""The orbit as an input: heat that arrives in full, dates that are needed, attitudes that are told, effects that act on it."""

from typing import Any

import numpy as np
import pytest

from tests.helpers import conductive_spec, model_of, record_of
from twin_core._typing import FloatArray
from twin_core.calibrate import calibrate
from twin_core.effects.channel_heat_load import ChannelHeatLoad
from twin_core.effects.input_gain import InputGain
from twin_core.effects.input_power_law import InputPowerLaw
from twin_core.errors import SpecError, TelemetryError
from twin_core.forecast import forecast
from twin_core.network.model import build_network
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import Forcing, build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record
from twin_core.units import parse_instant_ns

TLE = (
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)
EPOCH_NS = parse_instant_ns("2008-09-20T12:00:00Z")
PERIOD_S = 86_400.0 / 15.72125391
AREA_M2 = 0.02


def declared(attitude: Any = "nadir", **fields: Any) -> dict[str, Any]:
    """One node without a loss that the Sun shines on: its temperature counts the joules."""
    loads = [{"channel": f"orbit.sun_{'mean' if attitude == 'tumbling' else 'mz'}", "node": "n0"}]
    loads[0]["gain"] = {"value": AREA_M2}
    return conductive_spec(1, [], **({"orbit": {"tle": TLE, "attitude": attitude}, "loads": loads} | fields))


def dated(time_s: FloatArray, days: float = 0.0, **channels: Any) -> Record:
    """Return a record that begins some days after the epoch."""
    record = record_of(time_s, **({"T0": 290.0} | channels))
    return Record(record.time_s, record.values, EPOCH_NS + round(days * 86_400e9), "flight")


def forced(spec: dict[str, Any], record: Record, max_step_s: float = np.inf) -> Forcing:
    return build_forcing(build_network(load_spec(spec)), record, max_step_s)


def received_J_per_m2(spec: dict[str, Any], channel: str, start_s: float, stop_s: float) -> float:
    """Return the heat per area of a channel by the midpoint rule at half a second."""
    block = load_spec(spec).orbit
    assert block is not None
    environment, n = block.environment(), round((stop_s - start_s) * 2.0)
    sky = environment.sky(EPOCH_NS, start_s + (np.arange(n) + 0.5) * (stop_s - start_s) / n)
    return float(environment.quantities(sky)[channel.removeprefix("orbit.")].mean() * (stop_s - start_s))


@pytest.mark.parametrize("attitude", ["nadir", "tumbling"])
@pytest.mark.parametrize("sampling_s", [60.0, 10.0, 300.0])
def test_a_node_receives_the_heat_of_an_orbit(attitude: str, sampling_s: float) -> None:
    """The rise of its temperature times its capacity is the heat on its area to 1e-4, eclipse and all."""
    spec = declared(attitude)
    record = dated(np.arange(0.0, PERIOD_S + sampling_s, sampling_s))
    network = build_network(load_spec(spec))
    path = rollout(network, network.parameters.values, np.array([290.0]), forced(spec, record))
    rise_K = path.at_samples(forced(spec, record).sample_step)[-1, 0] - 290.0
    channel = spec["loads"][0]["channel"]
    heat_J = AREA_M2 * received_J_per_m2(spec, channel, 0.0, float(record.time_s[-1]))
    assert 5.0e3 * rise_K == pytest.approx(heat_J, rel=1e-4)


def test_every_channel_of_the_orbit_is_an_input() -> None:
    names = set(forced(declared(), dated(60.0 * np.arange(5))).inputs)
    faces = {f"{axis}{way}" for axis in "pm" for way in "xyz"}
    assert names == {f"orbit.{kind}_{face}" for kind in ("sun", "albedo", "earth") for face in faces} | {
        "orbit.eclipse",
        "orbit.beta",
    }
    tumbling = set(forced(declared("tumbling"), dated(60.0 * np.arange(5))).inputs)
    assert tumbling == {"orbit.sun_mean", "orbit.albedo_mean", "orbit.earth_mean", "orbit.eclipse", "orbit.beta"}


def test_telemetry_without_dates_is_refused() -> None:
    with pytest.raises(TelemetryError, match="the orbit needs dates; give a 'time' column"):
        forced(declared(), record_of(60.0 * np.arange(5), T0=290.0))


def test_elements_that_cannot_reach_the_telemetry_are_refused() -> None:
    late = Record(60.0 * np.arange(5), {"T0": np.full(5, 290.0)}, parse_instant_ns("2108-01-01T00:00:00Z"), "late")
    with pytest.raises(SpecError, match=r"orbit\.tle: SGP4 cannot propagate"):
        forced(declared(), late)


@pytest.mark.parametrize(("days", "told"), [(13.0, False), (15.0, True), (-20.0, True)])
def test_old_elements_are_told(days: float, told: bool) -> None:
    """More than two weeks between elements and forecast."""
    model = model_of(load_spec(declared()), {"C:n0": 5e3})
    state = {"time_s": 0.0, "nodes": ["n0"], "mean_K": [290.0], "covariance_K2": [[0.0]]}
    notices = forecast(model, dated(np.zeros(1), days), 600.0, step_s=60.0, state=state).notices
    assert [f"{abs(days):.0f} days from the telemetry" in n and "orbit.tle" in n for n in notices] == [True] * told


def test_a_forecast_knows_the_sunlight_to_come() -> None:
    """From inside the light through the eclipse: no plan says so, the orbit does."""
    spec = declared("tumbling")
    model = model_of(load_spec(spec), {"C:n0": 5e3})
    state = {"time_s": 0.0, "nodes": ["n0"], "mean_K": [290.0], "covariance_K2": [[0.0]]}
    found = forecast(model, dated(np.zeros(1)), 6000.0, step_s=600.0, state=state)
    heat_J = [AREA_M2 * received_J_per_m2(spec, "orbit.sun_mean", 0.0, t) for t in found.time_s]
    np.testing.assert_allclose(5.0e3 * (found.mean_K[:, 0] - 290.0), heat_J, atol=2e-4 * heat_J[-1])
    assert np.ptp(np.diff(heat_J)) > 0.5 * max(np.diff(heat_J))  # there is an eclipse in it


QUATERNIONS = {
    "attitude": {"quaternion_channels": ["q0", "q1", "q2", "q3"], "frame": "orbit"},
    "channels": {f"q{i}": {"kind": "auxiliary"} for i in range(4)},
}


def test_an_attitude_in_the_telemetry() -> None:
    """Parts that are missing now and then: what is told counts, whatever its length and sign."""
    time_s = 60.0 * np.arange(40)
    q0 = np.where(time_s % 420.0 == 0.0, np.nan, np.where(time_s > 900.0, -2.0, 1.0))
    told = forced(declared(**QUATERNIONS), dated(time_s, q0=q0, q1=0.0, q2=0.0, q3=0.0))
    fixed = forced(declared("nadir"), dated(time_s))
    for name, series in fixed.inputs.items():
        np.testing.assert_allclose(told.inputs[name], series, atol=1e-9)


def test_an_attitude_that_nobody_tells_is_refused() -> None:
    with pytest.raises(TelemetryError, match="channels q0, q1, q2, q3 tell no attitude"):
        forced(declared(**QUATERNIONS), dated(60.0 * np.arange(5), q0=0.0, q1=0.0, q2=0.0, q3=0.0))
    with pytest.raises(TelemetryError, match="channel 'q3' is missing"):
        forced(declared(**QUATERNIONS), dated(60.0 * np.arange(5), q0=1.0, q1=0.0, q2=0.0))


def test_effects_act_on_the_orbits_channels() -> None:
    """A gain on sunlight whose area is known; heat that follows the eclipse; a table over sunlight that nobody declared."""
    spec = load_spec(declared(**QUATERNIONS))
    layout = build_network(spec).layout
    assert {"channel": "orbit.sun_mz"} in list(InputGain.places(layout))
    assert list(InputPowerLaw.places(layout)) == []
    followed = [where["channel"] for where in ChannelHeatLoad.places(layout)]
    assert followed == ["orbit.eclipse"]

    record = dated(60.0 * np.arange(100), q0=1.0, q1=0.0, q2=0.0, q3=0.0)
    gain = InputGain({"channel": "orbit.sun_mz"}, {"g": 0.5})
    table = ChannelHeatLoad(
        {"node": "n0", "channel": "orbit.sun_px"},
        {"values_W[0]": 0.0, "values_W[1]": 15.0},
        {"knots": (0.0, 1500.0), "levels": False},
    )
    rises = []
    for effects in ((), (gain,), (table,)):
        network = build_network(spec, effects)
        forcing = build_forcing(network, record, 60.0)
        path = rollout(network, network.parameters.values, np.array([290.0]), forcing)
        rises.append(path.at_samples(forcing.sample_step)[-1, 0] - 290.0)
    assert rises[1] == pytest.approx(0.5 * rises[0], rel=1e-9)
    extra_J = 0.01 * received_J_per_m2(declared("nadir"), "orbit.sun_px", 0.0, float(record.time_s[-1]))
    assert 5.0e3 * (rises[2] - rises[0]) == pytest.approx(extra_J, rel=1e-3)


@pytest.mark.parametrize(("guessed", "days"), [(True, 0.0), (False, 20.0)])
def test_areas_are_calibrated_in_square_metres(guessed: bool, days: float) -> None:
    """Black and white plates declared alike come out apart, within four deviations of the truth; old elements are told."""
    truth = {"n0": 0.019, "n1": 0.007}

    def plates(**gains: Any) -> dict[str, Any]:
        return conductive_spec(
            2,
            [(0, 1)],
            boundaries={"space": {"value_K": 2.7}},
            radiators=[{"node": n, "emissivity": 0.8, "area_m2": 0.03, "sink": "space"} for n in truth],
            loads=[{"channel": "orbit.sun_mean", "node": n, **gains.get(n, {})} for n in truth]
            + [{"channel": "orbit.earth_mean", "node": n, "gain": {"value": 0.024}} for n in truth],
            orbit={"tle": list(TLE), "attitude": "tumbling"},
        )

    network = build_network(load_spec(plates(**{n: {"gain": {"value": area}} for n, area in truth.items()})))
    network = network.with_parameters(network.parameters.updated({"C:n0": 900.0, "C:n1": 900.0, "G:n0|n1": 0.02}))
    record = dated(60.0 * np.arange(280), days, T1=290.0)
    forcing = build_forcing(network, record, 60.0)
    path = rollout(network, network.parameters.values, np.array([290.0, 270.0]), forcing)
    noise = np.random.default_rng(3).normal(0.0, 0.1, (280, 2))
    read = path.at_samples(forcing.sample_step) + noise
    record = dated(record.time_s, days, T0=read[:, 0], T1=read[:, 1])

    model = calibrate(
        load_spec(plates(**({n: {"gain": {"guess": 0.012}} for n in truth} if guessed else {}))), [record]
    )
    rows = {row["name"]: row for row in model.summary["parameters"]}
    for node, area in truth.items():
        row = rows[f"gain:orbit.sun_mean|{node}"]
        assert row["unit"] == "m2" and row["identified"]
        assert row["mean"] == pytest.approx(area, abs=4.0 * row["std"]) and row["std"] < 0.05 * area
    assert any("orbit.tle" in notice for notice in model.summary["notices"]) == (days > 14.0)
