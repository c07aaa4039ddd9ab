"""What a spacecraft of solid bodies can hide: every effect of the vocabulary, acting in the field rather than on lumped nodes.

Heat enters over a spot on a face, radiation and convection act point by point, contacts change as contacts.
"""

from collections.abc import Callable

from benchmarks.worlds.hidden import couplings, drives, heats, sensing, storage
from benchmarks.worlds.hidden.base import Draft, Effect, Scene

EFFECTS: dict[str, Callable[[Scene], Draft]] = {
    draw.__name__: draw
    for draw in (
        heats.radiation_to_sink,
        couplings.radiative_exchange,
        couplings.missing_conductor,
        heats.leak_to_boundary,
        heats.nonlinear_convection,
        heats.constant_heat_load,
        heats.periodic_heat_load,
        heats.channel_heat_load,
        heats.thermostat_heater,
        heats.proportional_heater,
        drives.input_gain,
        drives.input_power_law,
        drives.input_step,
        drives.input_drift,
        couplings.conductance_step,
        couplings.conductance_temperature,
        storage.capacity_temperature,
        storage.latent_heat,
        heats.emissivity_step,
        storage.hidden_mass,
        heats.heat_load_step,
        drives.boundary_offset,
        drives.boundary_lag,
        drives.boundary_mix,
        sensing.sensor_bias,
        sensing.sensor_drift,
        sensing.sensor_lag,
    )
}
"""Effect -> draws its place from a scene."""

__all__ = ["EFFECTS", "Draft", "Effect", "Scene"]
