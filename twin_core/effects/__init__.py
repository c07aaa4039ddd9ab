"""The registry of effects: one missing-physics term per file, one line here."""

from typing import Any

from twin_core.effects.base import Effect, Quality, Survey, Where, require
from twin_core.effects.base import to_json as effect_to_json
from twin_core.effects.boundary_lag import BoundaryLag
from twin_core.effects.boundary_mix import BoundaryMix
from twin_core.effects.boundary_offset import BoundaryOffset
from twin_core.effects.capacity_temperature import CapacityTemperature
from twin_core.effects.channel_heat_load import ChannelHeatLoad
from twin_core.effects.conductance_step import ConductanceStep
from twin_core.effects.conductance_temperature import ConductanceTemperature
from twin_core.effects.constant_heat_load import ConstantHeatLoad
from twin_core.effects.emissivity_step import EmissivityStep
from twin_core.effects.heat_load_step import HeatLoadStep
from twin_core.effects.hidden_mass import HiddenMass
from twin_core.effects.input_drift import InputDrift
from twin_core.effects.input_gain import InputGain
from twin_core.effects.input_power_law import InputPowerLaw
from twin_core.effects.input_step import InputStep
from twin_core.effects.latent_heat import LatentHeat
from twin_core.effects.leak_to_boundary import LeakToBoundary
from twin_core.effects.learned_heat_flow import LearnedHeatFlow
from twin_core.effects.missing_conductor import MissingConductor
from twin_core.effects.nonlinear_convection import NonlinearConvection
from twin_core.effects.periodic_heat_load import PeriodicHeatLoad
from twin_core.effects.proportional_heater import ProportionalHeater
from twin_core.effects.radiation_to_sink import RadiationToSink
from twin_core.effects.radiative_exchange import RadiativeExchange
from twin_core.effects.sensor_bias import SensorBias
from twin_core.effects.sensor_drift import SensorDrift
from twin_core.effects.sensor_lag import SensorLag
from twin_core.effects.thermostat_heater import ThermostatHeater
from twin_core.errors import ModelError, SpecError

REGISTRY: dict[str, type[Effect]] = {
    effect.name: effect
    for effect in (
        RadiationToSink,
        RadiativeExchange,
        MissingConductor,
        LeakToBoundary,
        NonlinearConvection,
        ConstantHeatLoad,
        HeatLoadStep,
        PeriodicHeatLoad,
        ChannelHeatLoad,
        ThermostatHeater,
        ProportionalHeater,
        InputGain,
        InputPowerLaw,
        InputStep,
        InputDrift,
        ConductanceStep,
        ConductanceTemperature,
        EmissivityStep,
        CapacityTemperature,
        LatentHeat,
        HiddenMass,
        BoundaryOffset,
        BoundaryLag,
        BoundaryMix,
        SensorBias,
        SensorDrift,
        SensorLag,
        LearnedHeatFlow,
    )
}


def effect_from_json(data: Any, position: int = 0) -> Effect:
    """Return the effect that ``effect_to_json`` wrote.

    Raises
    ------
    SpecError
        Naming the field that is missing or wrong.
    """
    field = f"effects[{position}]"
    if not isinstance(data, dict) or data.get("effect") not in REGISTRY:
        name = data.get("effect") if isinstance(data, dict) else data
        raise SpecError(f"{field}.effect: unknown effect {name!r} (known: {', '.join(REGISTRY)})")
    kind = REGISTRY[data["effect"]]
    parts = {part: data.get(part, {}) for part in ("where", "settings", "values")}
    for part, given in parts.items():
        if not isinstance(given, dict):
            raise SpecError(f"{field}.{part}: must be a mapping")
    try:
        require(parts["where"], kind)
        settings = {k: tuple(v) if isinstance(v, list) else v for k, v in parts["settings"].items()}
        effect = kind(dict(parts["where"]), {k: float(v) for k, v in parts["values"].items()}, settings)
        lacking = [q.name for q in effect.qualities() if q.name not in effect.values]
    except ModelError as error:
        raise SpecError(f"{field}: {error}") from error
    except KeyError as error:
        raise SpecError(f"{field}.settings.{error.args[0]}: is missing") from error
    except (TypeError, ValueError) as error:
        raise SpecError(f"{field}.values: must be numbers ({error})") from error
    if lacking:
        raise SpecError(f"{field}.values.{lacking[0]}: is missing")
    return effect


__all__ = ["REGISTRY", "Effect", "Quality", "Survey", "Where", "effect_from_json", "effect_to_json"]
