"""Materials with their sources: conductivity, density, specific heat at about 20 degrees Celsius."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Material:
    """A homogeneous, isotropic material (in the plane of the cross-section)."""

    conductivity_W_per_m_K: float
    density_kg_per_m3: float
    specific_heat_J_per_kg_K: float

    @property
    def heat_capacity_J_per_m3_K(self) -> float:
        """Volumetric heat capacity."""
        return self.density_kg_per_m3 * self.specific_heat_J_per_kg_K


MATERIALS: dict[str, Material] = {
    # Metals: ASM handbook volume 2, room temperature.
    "aluminium_6061": Material(167.0, 2700.0, 896.0),
    "aluminium_7075": Material(130.0, 2810.0, 960.0),
    "magnesium_az31b": Material(96.0, 1770.0, 1024.0),
    "titanium_6al4v": Material(6.7, 4430.0, 526.0),
    "copper": Material(391.0, 8940.0, 385.0),
    "stainless_304": Material(16.2, 8000.0, 500.0),
    # Annealed pyrolytic graphite in an aluminium skin ("k-core" doublers): in-plane data of the makers' sheets.
    "graphite_doubler": Material(1000.0, 2300.0, 750.0),
    # Aluminium honeycomb panel with embedded constant-conductance heat pipes, smeared over its thickness
    # (Gilmore, Spacecraft Thermal Control Handbook, 2nd edition, chapter 14).
    "heat_pipe_panel": Material(3000.0, 900.0, 900.0),
    # Aluminium honeycomb sandwich, face sheets and core smeared over 20 mm (same handbook, appendix B).
    "honeycomb_sandwich": Material(8.0, 160.0, 900.0),
    # Electronics unit: aluminium housing and frames filled to about 40 %, boards smeared.
    "electronics_box": Material(120.0, 1100.0, 900.0),
    # Lithium-ion pack in aluminium frames, smeared; cells 900-1000 J/kg/K (Drake et al. 2014).
    "battery_pack": Material(60.0, 1800.0, 960.0),
    # Hydrazine in a titanium tank with aluminium collar, smeared; hydrazine 3080 J/kg/K, 1008 kg/m3.
    "hydrazine_tank": Material(40.0, 700.0, 2400.0),
    # Glass-fibre laminate, for isolating frames.
    "g10": Material(0.6, 1850.0, 900.0),
}
"""Built-in materials. A scenario may add its own under ``materials``."""
