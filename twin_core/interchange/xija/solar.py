"""Heat of the Sun on a node, by pitch, roll, season, ageing and the position of the instrument table."""

import math
from collections.abc import Sequence

from twin_core.interchange.xija.components import INSTRUMENTS, Component, instant
from twin_core.interchange.xija.draft import Draft, UnknownError

YEAR_DAYS = 365.3
"""Xija's year in days: a tenth of the 3,653 from 2000 to 2010. Source: ``SolarHeat.t_phase`` in xija/component/heat/solar.py."""

_POSITIONS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "all": (
        ("hrcs", -400000.0, -85000.0),
        ("hrci", -85000.0, 0.0),
        ("aciss", 0.0, 83000.0),
        ("acisi", 83000.0, 400000.0),
    ),
    "hrc-is": (("hrcs", -400000.0, -85000.0), ("hrci", -85000.0, 0.0), ("acis", 0.0, 400000.0)),
    "acis-is": (("acisi", -400000.0, 0.0), ("aciss", 0.0, 83000.0), ("hrc", 83000.0, 400000.0)),
}
"""Positions of the instrument table for each family of solar heat: name, above, up to, in steps of its motor. Source: classes of
that family in xija/component/heat/solar.py."""

HRC_S_STEPS = -86147.0
"""Up to this position of the instrument table, in steps of its motor, HRC-S is in the focal plane, from there to 0 HRC-I. Source:
``SolarHeatHrcOpts.dvals_post_hook`` in xija/component/heat/solar.py."""


def solar(write: Draft, component: Component) -> None:
    """Heat by pitch, ageing and season; the plain family adds the season, the multiplicative one scales with it."""
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    lit = _sunlit(write, component)
    ampl = component.par("ampl", 0.05)
    times = [lit] if lit else []
    if component.kind in ("SolarHeatMulplicative", "SolarHeatHrcMult"):
        times.append(f"(1.0 + {ampl!r} * {_season()})")
        if component.free & {"ampl"}:
            write.notes.append(f"{write.at(component)}: ampl is held, not calibrated")
    elif ampl:
        write.power(component, node, ampl, " * ".join([*times, _season()]), "ampl")
    factor = (
        lit
        if len(times) < 2 and lit
        else write.formula(f"{component.name}_season", " * ".join(times))
        if times
        else None
    )
    knots, aged = _pitches(component), _pitches(component, "dP_pitches")
    bias = component.par("bias")
    values, names = _values(component, "P", knots)
    write.table(component, node, pitch, knots, [v + bias for v in values], factor, [*names, "bias"])
    changes, names = _values(component, "dP", aged)
    _aged(write, component, node, pitch, aged, changes, times, names)
    if component.kind.startswith("SolarHeatHrc"):
        sim_z = write.channel(str(args.get("simz_comp") or "sim_z"), levels=True)
        for par, where in (
            ("hrc_bias", f"{sim_z} < 0.0"),
            ("hrci_bias", f"({sim_z} < 0.0) * ({sim_z} > {HRC_S_STEPS})"),
            ("hrcs_bias", f"{sim_z} <= {HRC_S_STEPS}"),
        ):
            write.power(component, node, component.par(par), where, par)


def solar_by_instrument(write: Draft, component: Component) -> None:
    """Heat by pitch and position of the instrument table."""
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    sim_z = write.channel(str(args.get("simz_comp") or "sim_z"), levels=True)
    knots, aged = _pitches(component), _pitches(component, "dP_pitches")
    for name, low, high in _POSITIONS[INSTRUMENTS[component.kind]]:
        factor = write.formula(f"at_{name}", f"({sim_z} > {low}) * ({sim_z} <= {high})")
        values, names = _values(component, f"P_{name}", knots)
        write.table(component, node, pitch, knots, values, factor, names)
    changes, names = _values(component, "dP", aged)
    _aged(write, component, node, pitch, aged, changes, [], names)
    write.power(component, node, component.par("ampl", 0.05), _season(), "ampl")
    name = str(args.get("dh_heater_comp") or "dh_heater")
    if write.constant.get(name) == 0.0:
        write.notes.append(f"{write.at(component)}: {name} is always 0; its heat is left out")
        return
    heater = write.channel(name, levels=True)
    write.power(component, node, component.par("dh_heater", 0.05), f"1.0 * {heater}", "dh_heater")


def off_nominal_roll(write: Draft, component: Component) -> None:
    args, node = component.args, str(component.args["node"])
    pitch = write.channel(str(args.get("pitch_comp") or "pitch"), unit="deg")
    roll = write.channel(str(args.get("roll_comp") or "roll"), unit="deg")
    lit = _sunlit(write, component)
    sun_y = write.formula("sun_y", f"sin(radians({pitch})) * sin(radians({roll}))")
    shade = f" * {lit}" if lit else ""
    write.power(component, node, component.par("P_plus_y"), f"max({sun_y}, 0.0){shade}", "P_plus_y")
    write.power(component, node, component.par("P_minus_y"), f"min({sun_y}, 0.0){shade}", "P_minus_y")


def _sunlit(write: Draft, component: Component) -> str | None:
    """Return the channel that is 1 in sunlight and 0 in eclipse; None where the component knows no eclipse."""
    eclipse = component.args.get("eclipse_comp")
    if eclipse is None:
        return None
    return write.formula("sunlit", f"1.0 - {write.channel(str(eclipse), levels=True)}")


def _season() -> str:
    return f"cos({2.0 * math.pi / YEAR_DAYS!r} * days('2000-01-01T00:00:00Z'))"


def _ageing(component: Component) -> str:
    """Return by how much heats have changed since their epoch, as a share of dP."""
    days = f"days('{instant(str(component.args.get('epoch', '2010:001:12:00:00')))}')"
    tau = component.par("tau", 1732.0)
    default = "linear" if component.kind in INSTRUMENTS else "exp"
    law = component.args.get("var_func", default)
    if law == "linear":
        return f"{days} / {tau!r}"
    if law == "exp":
        return f"1.0 - exp(-1.0 * {days} / {tau!r})"
    raise UnknownError(f"varies as '{law}'")


def _aged(
    write: Draft,
    component: Component,
    node: str,
    pitch: str,
    knots: Sequence[float],
    changes: Sequence[float],
    times: Sequence[str],
    names: Sequence[str],
) -> None:
    """Add what ageing adds to the heat by pitch."""
    if not any(changes):
        write.notes.append(f"{write.at(component)}: every dP is 0; ageing is left out")
        return
    if component.free & {"tau"}:
        write.notes.append(f"{write.at(component)}: tau of the ageing is held, not calibrated")
    factor = write.formula(f"{component.name}_ageing", " * ".join([*times, f"({_ageing(component)})"]))
    write.table(component, node, pitch, knots, changes, factor, names)


def _values(component: Component, prefix: str, pitches: Sequence[float]) -> tuple[list[float], list[str]]:
    names = [f"{prefix}_{p:.0f}" for p in pitches]
    if lacking := [n for n in names if n not in component.pars]:
        raise UnknownError(f"has no parameter {', '.join(lacking)}")
    return [component.par(n) for n in names], names


def _pitches(component: Component, key: str = "P_pitches") -> list[float]:
    return [float(p) for p in component.args.get(key) or component.args.get("P_pitches") or (45, 65, 90, 130, 180)]
