"""Assimilation against a filter written down densely, and its consistency on a matched model."""

import json

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

from tests.analytic import laplacian
from tests.helpers import conductive_spec, model_of, record_of
from twin_core.assimilate import FLOOR_SHARE, START_STD_HIDDEN_K, START_STD_SENSED_K, assimilate, memory_s
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import REGISTRY
from twin_core.errors import TelemetryError
from twin_core.network.spec_io import load_spec
from twin_core.simulate.forcing import build_forcing
from twin_core.simulate.rollout import rollout
from twin_core.telemetry import Record

POWER = {"kind": "power", "unit": "W"}
NOISE_K, MISFIT_K, LENGTH_S = 0.2, 0.3, 900.0
CAPACITY = {"C:n0": 4.0e3, "C:n1": 9.0e3, "C:n2": 2.0e3}
CONDUCTANCE = {"G:n0|n1": 3.0, "G:n1|n2": 1.0}


def chain_spec(**more: object) -> dict:
    data = conductive_spec(3, [(0, 1), (1, 2)], channels={"Q": POWER}, loads=[{"channel": "Q", "node": "n0"}])
    del data["nodes"][1]["sensor"]  # a node that nobody reads
    del data["channels"]["T1"]
    return data | more


def chain_model(**more: float) -> CalibratedModel:
    options = {"noise_K": NOISE_K, "misfit_K": MISFIT_K, "misfit_length_s": LENGTH_S, "max_step_s": 1e9} | more
    return model_of(load_spec(chain_spec()), CAPACITY | CONDUCTANCE, **options)


def chain_record(n_times: int = 120, seed: int = 0) -> Record:
    rng = np.random.default_rng(seed)
    time_s = np.cumsum(rng.uniform(40.0, 80.0, n_times))
    readings = {f"T{i}": 285.0 + np.cumsum(rng.normal(0.0, 0.3, n_times)) for i in (0, 2)}
    for column in readings.values():
        column[rng.random(n_times) < 0.2] = np.nan
    readings["T0"][40:60] = np.nan
    readings["T2"][50:55] = np.nan  # nothing at all for a while
    return record_of(time_s, Q=rng.choice([0.0, 30.0], n_times), **readings)


def scheme_map(rates_per_s: np.ndarray, drive: np.ndarray, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (A, b) of one step with held drive: the exponential of [[rates, drive], [0, 0]]."""
    n = drive.size
    z = np.zeros((n + 1, n + 1))
    z[:n, :n], z[:n, n] = rates_per_s * step_s, drive * step_s
    joint = expm(z)
    return joint[:n, :n], joint[:n, n]


def dense_filter(record: Record, density: np.ndarray, mean: np.ndarray, cov: np.ndarray) -> dict[str, np.ndarray]:
    """Textbook filter, all sensors of a sample at once (Särkkä and Svensson 2023, theorem 6.6)."""
    capacity = np.array(list(CAPACITY.values()))
    rates = -laplacian(3, [(0, 1), (1, 2)], list(CONDUCTANCE.values())) / capacity[:, None]
    measured = np.stack([record.values["T0"], record.values["T2"]], axis=1)
    observe = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    innovations, stds, nis = (
        np.full(measured.shape, np.nan),
        np.full(measured.shape, np.nan),
        np.full(len(measured), np.nan),
    )
    for k in range(len(measured)):
        if k:
            step = record.time_s[k] - record.time_s[k - 1]
            drive = np.array([record.values["Q"][k - 1] / capacity[0], 0.0, 0.0])
            transition, offset = scheme_map(rates, drive, step)
            mean, cov = transition @ mean + offset, transition @ cov @ transition.T + np.diag(density * step)
        seen = np.isfinite(measured[k])
        h = observe[seen]
        s = h @ cov @ h.T + NOISE_K**2 * np.eye(seen.sum())
        innovation = measured[k, seen] - h @ mean
        innovations[k, seen], stds[k] = innovation, np.sqrt(np.diag(observe @ cov @ observe.T) + NOISE_K**2)
        if seen.any():
            nis[k] = innovation @ np.linalg.solve(s, innovation)
            gain = np.linalg.solve(s, h @ cov).T
            mean, cov = mean + gain @ innovation, cov - gain @ s @ gain.T
    return {"innovation": innovations, "std": stds, "nis": nis, "mean": mean, "cov": cov}


def first_state(record: Record) -> tuple[np.ndarray, np.ndarray]:
    first = [column[np.isfinite(column)][0] for column in (record.values["T0"], record.values["T2"])]
    mean = np.array([first[0], np.mean(first), first[1]])
    return mean, np.diag([START_STD_SENSED_K**2, START_STD_HIDDEN_K**2, START_STD_SENSED_K**2])


def test_a_linear_network_is_a_dense_kalman_filter() -> None:
    record = chain_record()
    found = assimilate(chain_model(), record)
    density = np.full(3, 2.0 * MISFIT_K**2 / LENGTH_S)
    expected = dense_filter(record, density, *first_state(record))
    np.testing.assert_allclose(found.innovation_K, expected["innovation"], atol=1e-6)
    np.testing.assert_allclose(found.nis, expected["nis"], rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.mean_K, expected["mean"], atol=1e-6)
    np.testing.assert_allclose(found.covariance_K2, expected["cov"], atol=1e-8)
    np.testing.assert_allclose(found.innovation_std_K, expected["std"], rtol=1e-6)
    assert found.sensors == ("T0", "T2")


def test_without_misfit_a_floor_keeps_the_filter_awake() -> None:
    record = chain_record()
    sampling = float(np.median(np.diff(record.time_s)))
    expected = dense_filter(record, np.full(3, (FLOOR_SHARE * NOISE_K) ** 2 / sampling), *first_state(record))
    found = assimilate(chain_model(misfit_K=0.0), record)
    np.testing.assert_allclose(found.innovation_K, expected["innovation"], atol=1e-6)
    np.testing.assert_allclose(found.covariance_K2, expected["cov"], atol=1e-8)


def radiating_model() -> CalibratedModel:
    data = chain_spec(
        boundaries={"space": {"value_K": 3.0}},
        radiators=[{"node": "n2", "emissivity": 0.9, "area_m2": 0.15, "sink": "space"}],
    )
    options = {"noise_K": NOISE_K, "misfit_K": 0.0, "max_step_s": 1e9}
    return model_of(load_spec(data), CAPACITY | CONDUCTANCE, **options)


def truth_record(model: CalibratedModel, n_times: int, seed: int, noise_K: float = NOISE_K) -> Record:
    """Return readings of the model's own rollout with white noise."""
    rng = np.random.default_rng(seed)
    time_s = 60.0 * np.arange(n_times)
    blank = record_of(time_s, Q=np.repeat(rng.choice([20.0, 70.0, 110.0], n_times // 12 + 1), 12)[:n_times])
    network = model.network()
    forcing = build_forcing(network, blank, model.max_step_s)
    path = rollout(network, network.parameters.values, np.array([290.0, 285.0, 270.0]), forcing)
    states = path.at_samples(forcing.sample_step)
    readings = {f"T{i}": states[:, i] + rng.normal(0.0, noise_K, n_times) for i in (0, 2)}
    return Record(time_s, {**blank.values, **readings})


@pytest.mark.statistical
def test_nis_is_consistent_on_a_matched_model() -> None:
    """Over seeds the summed NIS of a matched model is chi-square, its freedom the number of readings."""
    model, total, count = radiating_model(), 0.0, 0
    for seed in range(6):
        found = assimilate(model, truth_record(model, 300, seed))
        # The filter starts at its first readings, and the node that nobody reads needs a while to be known.
        total += float(found.nis[30:].sum())
        count += int(np.isfinite(found.innovation_K[30:]).sum())
    low, high = chi2.ppf([0.001, 0.999], count)
    # The floor of the process noise widens the innovations by 1 % of the noise per sample: 2 % of the NIS at most.
    assert 0.98 * low < total < high


@pytest.mark.statistical
def test_innovations_of_a_matched_model_are_white() -> None:
    found = assimilate(radiating_model(), truth_record(radiating_model(), 1200, 11))
    scaled = (found.innovation_K / found.innovation_std_K)[30:]
    lag_one = np.mean(scaled[1:] * scaled[:-1], axis=0)
    assert np.abs(lag_one).max() < 3.3 / np.sqrt(scaled.shape[0])


@pytest.mark.parametrize("cut", [1, 60, 118])
def test_going_on_from_a_late_state_is_one_pass(cut: int) -> None:
    """A state written as JSON and read again continues the filter, with the same innovations."""
    model, record = radiating_model(), truth_record(radiating_model(), 120, 3)
    whole = assimilate(model, record)
    first = assimilate(model, record.take(np.arange(120) <= cut))
    state = json.loads(json.dumps(first.state))
    rest = assimilate(model, record.take(np.arange(120) >= cut), state)
    # The balance is linearised about each pass' own filtered states: equal to what the iterations leave.
    np.testing.assert_allclose(rest.innovation_K[1:], whole.innovation_K[cut + 1 :], atol=1e-4)
    np.testing.assert_allclose(rest.nis[1:], whole.nis[cut + 1 :], atol=1e-2)
    np.testing.assert_allclose(rest.mean_K, whole.mean_K, atol=1e-4)
    np.testing.assert_allclose(rest.covariance_K2, whole.covariance_K2, rtol=1e-3, atol=1e-6)
    assert np.isnan(rest.innovation_K[0]).all()  # its reading was used already
    assert rest.state["time_s"] == record.time_s[-1]


def test_a_state_of_another_network_is_not_taken_over() -> None:
    """After a model with a further state became active, the filter starts from the readings."""
    plain, record = radiating_model(), truth_record(radiating_model(), 120, 3)
    mass = REGISTRY["hidden_mass"]({"node": "n0"}, {"C_J_per_K": 1e3, "G_W_per_K": 1.0})
    richer = model_of(plain.spec, CAPACITY | CONDUCTANCE, effects=[mass], noise_K=NOISE_K, max_step_s=1e9)
    found = assimilate(richer, record, assimilate(plain, record.take(np.arange(120) < 2)).state)
    assert found.nodes == ("n0", "n1", "n2", "n0.hidden_mass")
    assert np.isfinite(found.mean_K).all()
    np.testing.assert_allclose(found.mean_K[[0, 2]], assimilate(plain, record).mean_K[[0, 2]], atol=5.0)


def test_nothing_is_used_where_nothing_is_read() -> None:
    record = chain_record()
    found = assimilate(chain_model(), record)
    np.testing.assert_array_equal(np.isnan(found.innovation_K[:, 0]), np.isnan(record.values["T0"]))
    blind = np.isnan(record.values["T0"]) & np.isnan(record.values["T2"])
    assert np.isnan(found.nis[blind]).all() and np.isfinite(found.nis[~blind]).all()
    assert np.linalg.eigvalsh(found.covariance_K2).min() > 0.0


def test_excluded_intervals_take_no_part() -> None:
    spec = load_spec(chain_spec(exclude=[{"start": 1000.0, "stop": 2000.0, "reason": "safe mode"}]))
    model = model_of(spec, CAPACITY | CONDUCTANCE, noise_K=NOISE_K, max_step_s=1e9)
    record = chain_record()
    found = assimilate(model, record)
    inside = (record.time_s >= 1000.0) & (record.time_s < 2000.0)
    assert np.isnan(found.innovation_K[inside]).all()
    assert np.isfinite(found.innovation_K[~inside]).any()


def test_a_record_without_readings_is_refused() -> None:
    time_s = 60.0 * np.arange(10)
    with pytest.raises(TelemetryError, match="record: holds no reading of T0, T2"):
        assimilate(chain_model(), record_of(time_s, Q=1.0, T0=np.nan, T2=np.nan))


def test_a_record_without_its_input_is_refused() -> None:
    with pytest.raises(TelemetryError, match="channel 'Q' is missing"):
        assimilate(chain_model(), record_of(60.0 * np.arange(10), T0=280.0, T2=280.0))


def test_one_sample_is_enough() -> None:
    found = assimilate(chain_model(), record_of(np.array([5.0]), Q=1.0, T0=280.0, T2=np.nan))
    assert found.mean_K[0] == pytest.approx(280.0)
    assert found.time_s.tolist() == [5.0]


def test_a_silent_sensor_is_no_obstacle() -> None:
    found = assimilate(chain_model(), record_of(60.0 * np.arange(20), Q=0.0, T0=280.0))
    assert np.isnan(found.innovation_K[:, 1]).all()


def jumped(gap_s: float) -> Record:
    """Return a record with one interval of ``gap_s`` in its middle; its input is silent right after it."""
    record = chain_record()
    time_s = record.time_s.copy()
    time_s[60:] += gap_s
    values = {name: column.copy() for name, column in record.values.items()}
    values["Q"][60:] = np.nan
    return Record(time_s, values, record.epoch_ns, "jumped")


@pytest.mark.parametrize("gap_s", [6.1e5, 5.2e9])
def test_after_a_long_gap_the_filter_starts_anew(gap_s: float) -> None:
    model, record = chain_model(max_step_s=60.0), jumped(gap_s)
    whole = assimilate(model, record)
    later = record.take(np.arange(60, 120))
    held = np.full(60, record.values["Q"][59])
    alone = assimilate(model, Record(later.time_s, {**later.values, "Q": held}, record.epoch_ns, "later"))
    np.testing.assert_array_equal(whole.innovation_K[60:], alone.innovation_K)
    np.testing.assert_array_equal(whole.mean_K, alone.mean_K)
    np.testing.assert_array_equal(whole.covariance_K2, alone.covariance_K2)
    resumed = assimilate(model, record.take(np.arange(59, 120)), assimilate(model, record.take(np.arange(60))).state)
    np.testing.assert_array_equal(resumed.innovation_K[1:], alone.innovation_K)


def test_after_a_long_gap_without_readings_the_state_is_kept_but_not_trusted() -> None:
    model, record = chain_model(max_step_s=60.0), chain_record()
    state = assimilate(model, record).state
    silent = record_of(np.array([record.time_s[-1], 5.2e9]), Q=[0.0, 0.0], T0=[np.nan] * 2, T2=[np.nan] * 2)
    done = assimilate(model, silent, state)
    np.testing.assert_array_equal(done.mean_K, state["mean_K"])
    np.testing.assert_array_equal(done.covariance_K2, START_STD_HIDDEN_K**2 * np.eye(3))


def test_many_steps_are_filtered_in_pieces_with_the_same_result(monkeypatch: pytest.MonkeyPatch) -> None:
    model, record = chain_model(max_step_s=20.0), chain_record()
    whole = assimilate(model, record)
    monkeypatch.setattr("twin_core.assimilate.MOST_STEPS", 50)
    pieces = assimilate(model, record)
    np.testing.assert_allclose(pieces.innovation_K, whole.innovation_K, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pieces.nis, whole.nis, rtol=1e-9)
    np.testing.assert_allclose(pieces.covariance_K2, whole.covariance_K2, rtol=1e-9)


@pytest.mark.parametrize("wall_W_per_K", [0.5, 20.0])
def test_a_network_remembers_for_its_longest_time_constant(wall_W_per_K: float) -> None:
    """The slowest mode of C dT/dt = -L T, found by NumPy from the matrices written down."""
    data = chain_spec(boundaries={"wall": {"value_K": 280.0}})
    data["conductors"].append({"between": ["n2", "wall"]})
    model = model_of(load_spec(data), CAPACITY | CONDUCTANCE | {"G:n2|wall": wall_W_per_K}, **{"max_step_s": 10.0})
    exchange = np.array([[3.0, -3.0, 0.0], [-3.0, 4.0, -1.0], [0.0, -1.0, 1.0 + wall_W_per_K]])
    rates = np.linalg.eigvals(exchange / np.array([4.0e3, 9.0e3, 2.0e3])[:, None])
    np.testing.assert_allclose(memory_s(model, chain_record()), 1.0 / rates.real.min(), rtol=1e-3)


def test_an_isolated_network_remembers_for_ever() -> None:
    assert memory_s(chain_model(), chain_record()) > 1e9
