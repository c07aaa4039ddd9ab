"""The model file: there and back bit for bit, and every damage named."""

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.helpers import EVERY_TERM, EVERY_TERM_KNOTS, active_effect, every_term_network
from twin_core.calibrate.result import CalibratedModel
from twin_core.effects import REGISTRY
from twin_core.errors import SpecError
from twin_core.network.spec_io import load_spec


def every_model(*names: str) -> CalibratedModel:
    """Return a model of the network with every term and some effects, at numbers that no decimal text hits by luck."""
    effects = tuple(active_effect(REGISTRY[name], 1.0 / 3.0) for name in names)
    parameters = every_term_network(effects).parameters
    rng = np.random.default_rng(0)
    free = parameters.at_free(parameters.free + rng.normal(0.0, 0.1, parameters.free.size))
    root = rng.normal(size=(parameters.free.size,) * 2)
    each = {"T_a": 0.1 / 3.0, "T_b": 0.2 / 3.0}
    named = free.as_dict()
    return CalibratedModel(
        load_spec(EVERY_TERM),
        tuple(effect.at_parameters(named) for effect in effects),
        named,
        root @ root.T,
        free.free_names,
        each,
        {s: 1.0 / 7.0 for s in each},
        {s: 1000.0 / 7.0 for s in each},
        60.0 / 7.0,
        EVERY_TERM_KNOTS,
        {"words": ["fine"], "rmse_K": 1.0 / 3.0, "train": {"start": "2026-01-01T00:00:00Z"}},
    )


def through_text(model: CalibratedModel) -> CalibratedModel:
    return CalibratedModel.from_json(json.loads(json.dumps(model.to_json(), allow_nan=False)))


@pytest.mark.parametrize("names", [(), *((name,) for name in REGISTRY), ("input_gain", "hidden_mass", "sensor_lag")])
def test_a_model_file_is_read_back_bit_for_bit(names: tuple[str, ...]) -> None:
    model = every_model(*names)
    again = through_text(model)
    np.testing.assert_array_equal(again.covariance, model.covariance)
    for field in ("spec", "effects", "values", "free_names", "noise_K", "misfit_K", "misfit_length_s", "max_step_s"):
        assert getattr(again, field) == getattr(model, field), field
    assert again.table_knots == model.table_knots
    assert again.summary == model.summary
    assert again.to_json() == model.to_json()
    np.testing.assert_array_equal(again.network().parameters.values, model.network().parameters.values)


def test_a_model_without_free_parameters_is_a_model() -> None:
    data = every_model().to_json()
    data["free_names"], data["covariance"] = [], []
    assert CalibratedModel.from_json(data).covariance.shape == (0, 0)


def edited(change: Callable[[dict[str, Any]], Any]) -> dict[str, Any]:
    data = copy.deepcopy(every_model("leak_to_boundary").to_json())
    change(data)
    return data


FIELDS = (
    "spec",
    "effects",
    "values",
    "free_names",
    "covariance",
    "noise_K",
    "misfit_K",
    "misfit_length_s",
    "max_step_s",
    "table_knots",
    "summary",
)


@pytest.mark.parametrize("field", FIELDS)
def test_a_missing_field_is_named(field: str) -> None:
    with pytest.raises(SpecError, match=rf"^{field}: is missing"):
        CalibratedModel.from_json(edited(lambda d: d.pop(field)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format="thermal-twin-model/99"), "format: not a model file"),
        (lambda d: d["noise_K"].pop("T_b"), "T_b: is missing"),
        (lambda d: d["values"].pop("C:a"), r"values\.C:a: is missing"),
        (lambda d: d["values"].update({"C:a": float("nan")}), r"values\.C:a: is not a finite number"),
        (lambda d: d["values"].update({"C:a": "much"}), "damaged"),
        (lambda d: d["covariance"].pop(), "damaged"),
        (lambda d: d["covariance"][0].pop(), "damaged"),
        (lambda d: d.update(values=[1, 2]), "damaged"),
        (lambda d: d.update(max_step_s=None), "damaged"),
        (lambda d: d["effects"][0].update(effect="nothing"), r"effects\[0\]\.effect: unknown effect 'nothing'"),
        (lambda d: d["effects"][0]["where"].update(node="nowhere"), "effects: unknown node 'nowhere'"),
        (lambda d: d["effects"][0]["where"].pop("node"), r"where\.node is missing"),
        (lambda d: d["effects"][0]["values"].clear(), r"effects\[0\]\.values\.G_W_per_K: is missing"),
        (lambda d: d["effects"][0].pop("where"), r"where\.node is missing"),
        (lambda d: d["effects"][0].update(settings=[1]), r"effects\[0\]"),
        (lambda d: d["effects"][0].update(values=3), r"effects\[0\]"),
        (lambda d: d["spec"]["nodes"][0].update(id="9"), "nodes"),
        (lambda d: d["table_knots"][0].pop("node"), "node: is missing"),
        (lambda d: d["max_step_s"] and d.update(max_step_s=-1.0), "max_step_s"),
        (lambda d: d.update(max_step_s=1e-9), "max_step_s: must be at least 0.001 s"),
        (lambda d: d["values"].update({"C:a": 1e-300}), r"values\.C:a: is out of all proportion"),
        (lambda d: d["noise_K"].update(T_a=float("nan")), "noise_K"),
        (lambda d: d["noise_K"].update(T_a=-0.1), "noise_K"),
        (lambda d: d["misfit_length_s"].update(T_a=float("inf")), "misfit_length_s"),
        (lambda d: d["covariance"][0].__setitem__(0, float("nan")), "covariance"),
        (lambda d: d["misfit_K"].update(T_a=-1.0), "misfit_K"),
        (lambda d: d["values"].update({"C:a": -5.0}), r"values\.C:a: must be positive"),
        (lambda d: d["free_names"].reverse(), "free_names"),
        (lambda d: d["effects"][0]["values"].update(G_W_per_K="x"), r"effects\[0\]\.values: must be numbers"),
    ],
)
def test_a_damaged_model_file_is_named(change: Callable[[dict[str, Any]], Any], message: str) -> None:
    with pytest.raises(SpecError, match=message):
        CalibratedModel.from_json(edited(change))


def test_a_missing_setting_is_named() -> None:
    data = every_model("learned_heat_flow").to_json()
    for setting in ("degree", "low_K"):
        damaged = copy.deepcopy(data)
        del damaged["effects"][0]["settings"][setting]
        with pytest.raises(SpecError, match=setting):
            CalibratedModel.from_json(damaged)


@pytest.mark.parametrize("data", [None, [], "model", 3, {}, {"format": None}])
def test_what_is_no_model_is_refused(data: Any) -> None:
    with pytest.raises(SpecError, match="format: not a model file of this program"):
        CalibratedModel.from_json(data)
