"""The registry of effects: one missing-physics term per file, one line here."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from twin_core.effects.base import Effect, ParameterSpec, Survey, Where
from twin_core.effects.base import read as read_effect
from twin_core.effects.base import to_json as effect_to_json
from twin_core.effects.boundary_lag import BoundaryLag
from twin_core.effects.boundary_mix import BoundaryMix
from twin_core.effects.boundary_offset import BoundaryOffset
from twin_core.effects.capacity_temperature import CapacityTemperature
from twin_core.effects.channel_heat_load import ChannelHeatLoad
from twin_core.effects.check import check_effect, require_sound
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
from twin_core.effects.plugins import effects_in_file, remedy
from twin_core.effects.proportional_heater import ProportionalHeater
from twin_core.effects.radiation_to_sink import RadiationToSink
from twin_core.effects.radiative_exchange import RadiativeExchange
from twin_core.effects.registry import Registry
from twin_core.effects.sensor_bias import SensorBias
from twin_core.effects.sensor_drift import SensorDrift
from twin_core.effects.sensor_lag import SensorLag
from twin_core.effects.thermostat_heater import ThermostatHeater
from twin_core.errors import SpecError

REGISTRY = Registry(
    (
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
)


def load_effects(files: Iterable[Path | str], *, check: bool = True) -> list[type[Effect]]:
    """Return the effects of plug-in files; from here on they are known wherever an effect is looked for or read.

    A file that was loaded before is not loaded again.

    Parameters
    ----------
    files
        Python files, each with one or more subclasses of ``Effect``.
    check
        Whether their derivatives and conventions are checked first.

    Raises
    ------
    PluginError
        Naming the file, what is wrong with it, and what to do.
    """
    kinds: list[type[Effect]] = []
    for file in map(Path, files):
        found = effects_in_file(file)
        if check and not all(REGISTRY.holds(kind) for kind in found):
            require_sound({kind: check_effect(kind) for kind in found}, file)
        for kind in found:
            REGISTRY.add(kind, str(file), file.name)
        kinds += found
    return kinds


def effect_from_json(data: Any, position: int = 0) -> Effect:
    """Return the effect that ``effect_to_json`` wrote.

    Raises
    ------
    SpecError
        Naming the field that is missing or wrong; for the effect of a plug-in that is not there, which one to give.
    """
    field = f"effects[{position}]"
    name = data.get("effect") if isinstance(data, dict) else data
    if not isinstance(data, dict) or not isinstance(name, str) or name not in REGISTRY:
        plugin = data.get("plugin") if isinstance(data, dict) else None
        if isinstance(plugin, str) and plugin:
            raise SpecError(f"{field}.effect: unknown effect {name!r}, which comes from a plug-in; {remedy(plugin)}")
        raise SpecError(f"{field}.effect: unknown effect {name!r} (known: {', '.join(REGISTRY)})")
    return read_effect(REGISTRY[name], data, field)


__all__ = [
    "REGISTRY",
    "Effect",
    "ParameterSpec",
    "Survey",
    "Where",
    "effect_from_json",
    "effect_to_json",
    "load_effects",
]
