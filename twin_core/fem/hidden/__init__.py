"""Effects that a scenario may hide. Adding one is one class and one name in ``AnyHiddenEffect``."""

from typing import Annotated

from pydantic import Field

from twin_core.fem.hidden.base import Bound, HiddenEffect, Mass, Moment, Plant
from twin_core.fem.hidden.coupling import ConductanceStep, ConductanceTemperature, EmissivityStep
from twin_core.fem.hidden.exchange import (
    LeakToBoundary,
    MissingConductor,
    NonlinearConvection,
    RadiationToSink,
    RadiativeExchange,
)
from twin_core.fem.hidden.heating import (
    ChannelHeatLoad,
    ConstantHeatLoad,
    PeriodicHeatLoad,
    ProportionalHeater,
    ThermostatHeater,
)
from twin_core.fem.hidden.inputs import InputDrift, InputGain, InputPowerLaw, InputStep
from twin_core.fem.hidden.sensing import SensorBias, SensorDrift, SensorLag
from twin_core.fem.hidden.storage import CapacityTemperature, HiddenMass, LatentHeat

AnyHiddenEffect = Annotated[
    RadiationToSink
    | RadiativeExchange
    | MissingConductor
    | LeakToBoundary
    | NonlinearConvection
    | ConstantHeatLoad
    | PeriodicHeatLoad
    | ChannelHeatLoad
    | ThermostatHeater
    | ProportionalHeater
    | InputGain
    | InputPowerLaw
    | InputStep
    | InputDrift
    | ConductanceStep
    | ConductanceTemperature
    | EmissivityStep
    | CapacityTemperature
    | LatentHeat
    | HiddenMass
    | SensorBias
    | SensorDrift
    | SensorLag,
    Field(discriminator="effect"),
]
"""The registry: names as in the reports of the closed loop."""

__all__ = ["AnyHiddenEffect", "Bound", "HiddenEffect", "Mass", "Moment", "Plant"]
