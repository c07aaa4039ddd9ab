"""The second finite-element world against closed forms, its own refinement and the balance of its energy."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.solid_cases import solid_case
from benchmarks.worlds.body import FACES, WHOLE, Body, angle_bracket, block, tube
from benchmarks.worlds.field import Contact, Plan, assemble
from benchmarks.worlds.hidden import EFFECTS, Scene
from benchmarks.worlds.hidden.sensing import lag_exact
from benchmarks.worlds.orbits import EARTH_M, MU_M3_PER_S2, Orbit
from benchmarks.worlds.spacecraft import Spacecraft, draw_spacecraft
from benchmarks.worlds.stepping import GAMMA, SIGMA_W_PER_M2_K4, SPACE_K, Acting, Drive, Stepper, steady
from twin_core.calibrate.second_order import fit_trajectories

CAPACITY = 2.4e6


def slab(n: int, conductivity: float = 5.0) -> Body:
    """Return a slab of 0.2 m, heated and read along its first direction."""
    return block((0.2, 0.1, 0.1), (n, 1, 1), (conductivity,) * 3, CAPACITY)


def plan(bodies: dict[str, Body], **more: object) -> Plan:
    """Return a plan of bodies that are nodes of their own."""
    empty: dict[str, object] = {"contacts": [], "radiators": {}, "mounts": [], "inputs": {}, "sensors": {}}
    groups = {name: (name,) for name in bodies}
    return Plan(bodies, groups, **(empty | {"heater_spots": {}} | more))  # type: ignore[arg-type]


def drive(n_steps: int, step_s: float, power: object, sink_K: float = 290.0) -> Drive:
    """Return steps with a power that is a function of time."""
    at = step_s * (np.arange(n_steps)[:, None] + np.array([GAMMA, 1.0]))
    return Drive(0.0, step_s, {"P": power(at)}, {"bus": np.full_like(at, sink_K)})  # type: ignore[operator]


@pytest.mark.parametrize(
    ("body", "volume_m3", "areas_m2"),
    [
        (block((0.4, 0.3, 0.02), (5, 4, 1), (1.0,) * 3, 1.0), 0.0024, {"-1": 0.006, "+2": 0.008, "+3": 0.12}),
        (
            angle_bracket((0.2, 0.3), 0.1, 0.01, (4, 3, 5), (1.0,) * 3, 1.0),
            0.00049,
            {"-3": 0.02, "-1": 0.03, "+1": 1e-3},
        ),
        (tube(0.15, 0.004, 0.5, (1, 60, 4), (1.0,) * 3, 1.0), np.pi * (0.15**2 - 0.146**2) * 0.5, {"+1": np.pi * 0.15}),
    ],
)
def test_bodies_have_the_volume_and_the_faces_of_their_shape(
    body: Body, volume_m3: float, areas_m2: dict[str, float]
) -> None:
    capacity, conduction = body.matrices()
    assert capacity.sum() == pytest.approx(volume_m3, rel=4e-3)
    np.testing.assert_allclose(conduction @ np.ones(body.n_vertices), 0.0, atol=1e-12)
    for face, area in areas_m2.items():
        assert body.patch(face, WHOLE).area_m2.sum() == pytest.approx(area, rel=4e-3)
    for face in FACES:
        assert body.patch(face, ((0.2, 0.7), (0.1, 0.6))).spread.sum() == pytest.approx(1.0)


def test_a_point_reads_a_linear_field_exactly() -> None:
    body = angle_bracket((0.2, 0.3), 0.1, 0.01, (4, 3, 5), (1.0,) * 3, 1.0)
    field = np.array([2.0, -3.0, 5.0]) @ body.mesh.p
    place = body.mesh.p @ body.point("-1", 0.3, 0.8)
    assert body.point("-1", 0.3, 0.8) @ field == pytest.approx(np.array([2.0, -3.0, 5.0]) @ place)


def test_steady_heat_through_two_slabs_a_contact_and_a_radiating_face() -> None:
    heat_W, h, area = 7.0, 150.0, 0.01
    built = assemble(
        plan(
            {"a": slab(3), "b": slab(4, 9.0)},
            contacts=[Contact((("a", "+1", WHOLE), ("b", "-1", WHOLE)), h)],
            radiators={"b": (("b", "+1", WHOLE), 0.8)},
            inputs={"P": ("a", "-1", WHOLE)},
        )
    )
    here = steady(built, {"P": heat_W}, {})
    cold = (heat_W / (SIGMA_W_PER_M2_K4 * 0.8 * area) + SPACE_K**4) ** 0.25
    drops = heat_W / area * np.array([0.0, 0.2 / 9.0, 0.2 / 9.0 + 1.0 / h, 0.2 / 9.0 + 1.0 / h + 0.2 / 5.0])
    n = built.n - 5 * 4
    ends = [here[n:].min(), here[n:].max(), here[:n].min(), here[:n].max()]
    np.testing.assert_allclose(ends, cold + drops, rtol=1e-9)


def heated_slab_K(depth_m: float, time_s: float, flux: float, k: float = 5.0, length: float = 0.2) -> float:
    """Return the rise at a depth under constant flux, far side insulated (Carslaw and Jaeger, 2nd ed., 3.8 eq. 3)."""
    a, x = k / CAPACITY, length - depth_m
    n = np.arange(1, 400)
    series = np.sum(
        (-1.0) ** n / n**2 * np.exp(-a * (n * np.pi / length) ** 2 * time_s) * np.cos(n * np.pi * x / length)
    )
    return float(
        flux * time_s / (CAPACITY * length)
        + flux * length / k * ((3 * x**2 - length**2) / (6 * length**2) - 2 / np.pi**2 * series)
    )


def test_a_suddenly_heated_slab_follows_the_series_with_order_two_in_the_mesh() -> None:
    errors = []
    for n in (4, 8, 16):
        built = assemble(plan({"a": slab(n)}, inputs={"P": ("a", "-1", WHOLE)}))
        watch = np.stack([slab(n).point("-1", 0.5, 0.5), slab(n).point("+1", 0.5, 0.5)])
        seen = Stepper(built, drive(400, 10.0, lambda t: 20.0 + 0 * t)).run(np.full(built.n, 300.0), watch)
        exact = 300.0 + np.array([heated_slab_K(x, 4000.0, 2000.0) for x in (0.0, 0.2)])
        errors.append(np.abs(seen[-1] - exact).max())
    assert errors[-1] < 1e-3 * 60.0
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.35)


def test_steps_have_order_two_with_radiation_and_switching_power() -> None:
    built = assemble(plan({"a": slab(6)}, inputs={"P": ("a", "-1", WHOLE)}, radiators={"a": (("a", "+1", WHOLE), 0.9)}))
    watch = slab(6).point("-1", 0.5, 0.5)[None]
    ends = {}
    for n in (40, 80, 1280):
        smooth = drive(n, 8000.0 / n, lambda t: 15.0 * (t < 4000.0 + 1e-9) + 5.0 * np.sin(t / 700.0))
        ends[n] = Stepper(built, smooth).run(np.full(built.n, 280.0), watch)[:: n // 40, 0]
    errors = [np.abs(ends[n] - ends[1280]).max() for n in (40, 80)]
    assert errors[0] < 0.3
    assert np.log2(errors[0] / errors[1]) > 1.6


def test_energy_is_balanced_with_everything_at_work() -> None:
    craft = draw_spacecraft(4, 10.0)
    short = replace(craft, n_samples=60, n_lead=0, power_W={c: q[:60] for c, q in craft.power_W.items()},
                    boundaries_K={b: t[:60] for b, t in craft.boundaries_K.items()}, auxiliary={}).refine().refine()  # fmt: skip
    built, steps = short.field, short.drive
    path = Stepper(built, steps).run(short.start_K + 5.0, np.eye(built.n))
    stored = built.capacity_J_per_K @ (path[-1] - path[0])
    area = SIGMA_W_PER_M2_K4 * sum(built.radiating_m2.values())
    rate = (SPACE_K**4 - path**4) @ area
    moved = np.abs(rate).sum() * steps.step_s
    for boundary, row in built.to_boundary_W_per_K.items():
        sink = np.concatenate([steps.boundaries_K[boundary][:1, 0], steps.boundaries_K[boundary][:, 1]])
        rate = rate + sink * row.sum() - path @ row
    received = steps.step_s * (rate.sum() - 0.5 * (rate[0] + rate[-1]))
    weights = np.array([1.0 - GAMMA, GAMMA])
    received += steps.step_s * sum((q @ weights).sum() for q in steps.inputs_W.values())
    assert stored == pytest.approx(received, abs=1e-4 * moved)


def test_a_melting_block_stores_its_latent_heat() -> None:
    built = assemble(plan({"a": slab(2, 500.0)}, inputs={"P": ("a", "-1", WHOLE)}))
    share, latent = built.shares["a"], 3.0e4
    from scipy.special import ndtr

    acting = Acting(
        stored_J=lambda x: latent * share * ndtr((x - 305.0) / 0.5),
        slope_J_per_K=lambda x: latent * share * np.exp(-2.0 * (x - 305.0) ** 2) / (0.5 * np.sqrt(2 * np.pi)),
    )
    seen = Stepper(built, drive(400, 30.0, lambda t: 10.0 + 0 * t), acting).run(np.full(built.n, 300.0), share[None])
    rise = (10.0 * 12_000.0 - latent) / built.capacity_J_per_K.sum()
    assert seen[-1, 0] - 300.0 == pytest.approx(rise, abs=2e-3)


@cache
def short(refined: int) -> tuple[Spacecraft, np.ndarray]:
    """Return a spacecraft with a short record, and its healthy readings."""
    craft, lead, n = draw_spacecraft(20, 10.0), 20, 180
    cut = {
        part: {name: series[: lead + n] for name, series in getattr(craft, part).items()}
        for part in ("power_W", "auxiliary", "boundaries_K")
    }
    craft = replace(craft, n_lead=lead, n_samples=n, refined=refined, **cut)
    return craft, craft.read()


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_effects_move_the_readings_and_halving_the_step_does_not(name: str) -> None:
    moved = []
    for refined in (1, 2):
        craft, healthy = short(refined)
        draft = EFFECTS[name](Scene(np.random.default_rng(3), craft, short(1)[1]))
        made = draft.make(float(np.clip(draft.first, draft.least, draft.most)))
        if made.reading is not None:
            seen = made.reading(np.arange(len(healthy)) * craft.drive.step_s, healthy)
        else:
            seen = craft.read(made.acting, craft.drive if made.drive is None else made.drive(craft.drive))
        moved.append((seen - healthy)[:: craft.per_sample])
    assert np.abs(moved[0]).max() > 0.005
    assert np.sqrt(np.mean((moved[1] - moved[0]) ** 2)) < 0.02 * np.sqrt(np.mean(moved[0] ** 2)) + 1e-4


def test_heat_between_nodes_is_conserved() -> None:
    craft, healthy = short(1)
    scene = Scene(np.random.default_rng(1), craft, healthy)
    x = np.random.default_rng(2).uniform(270.0, 310.0, craft.field.n)
    for name in ("radiative_exchange", "conductance_temperature"):
        draft = EFFECTS[name](scene)
        heat = draft.make(draft.first).acting.heat
        assert heat is not None
        flow = heat(None, x)  # type: ignore[arg-type]
        assert abs(flow.sum()) < 1e-9 * np.abs(flow).sum()
    for name in ("missing_conductor", "hidden_mass", "conductance_step"):
        draft = EFFECTS[name](scene)
        added = draft.make(draft.first).acting.stiffness_W_per_K
        assert added is not None
        np.testing.assert_allclose(added @ np.ones(added.shape[0]), 0.0, atol=1e-9)


def test_a_lag_is_exact_on_a_ramp() -> None:
    t = np.arange(200) * 30.0
    exact = 0.01 * (t - 400.0 * (1.0 - np.exp(-t / 400.0)))
    np.testing.assert_allclose(lag_exact(0.01 * t, 30.0, 400.0), exact, atol=1e-9)


def orbit(**more: object) -> Orbit:
    """Return a circular orbit in the plane of the Sun, with changes."""
    usual: dict[str, object] = {"kind": "low", "perigee_m": EARTH_M + 6e5, "eccentricity": 0.0, "beta_rad": 0.0,
                                "node_rad": 0.0, "attitude": "nadir", "spin_s": 600.0, "heading_rad": 0.0,
                                "slews": (), "albedo": 0.0}  # fmt: skip
    return Orbit(**(usual | more))  # type: ignore[arg-type]


def test_the_shadow_of_a_circular_orbit_lasts_as_long_as_its_geometry_says() -> None:
    low = orbit()
    lit = low.lit(np.linspace(0.0, low.period_s, 20_001)).mean()
    assert lit == pytest.approx(1.0 - np.arcsin(EARTH_M / low.perigee_m) / np.pi, abs=2e-3)
    assert orbit(beta_rad=1.4).lit(np.linspace(0.0, low.period_s, 999)).min() == 1.0


def test_an_eccentric_orbit_keeps_its_energy_and_its_angular_momentum() -> None:
    far = orbit(eccentricity=0.7, node_rad=1.0)
    t = np.linspace(0.0, far.period_s, 40_001)
    distance, angle = far.position(t)
    place = distance * np.exp(1j * angle)
    speed = np.gradient(place, t)[5:-5]
    place = place[5:-5]
    axis = far.perigee_m / 0.3
    np.testing.assert_allclose(0.5 * abs(speed) ** 2 - MU_M3_PER_S2 / abs(place), -0.5 * MU_M3_PER_S2 / axis, rtol=1e-4)
    momentum = (place.conjugate() * speed).imag
    np.testing.assert_allclose(momentum, np.sqrt(MU_M3_PER_S2 * axis * (1 - 0.49)), rtol=1e-4)


def test_a_face_towards_the_sun_gets_the_solar_constant_and_one_away_nothing() -> None:
    still = orbit(attitude="inertial", perigee_m=4.2164e7)
    t = np.linspace(0.0, 0.2 * still.period_s, 50)
    assert still.flux_W_per_m2(np.array([1.0, 0.0, 0.0]), t)[0] == pytest.approx(1361.0)
    assert still.flux_W_per_m2(np.array([-1.0, 0.0, 0.0]), t)[0] == pytest.approx(0.0)


def test_a_case_is_told_by_its_sensors_and_missed_by_its_network() -> None:
    case = solid_case("sensor_drift", 3)
    (truth,) = case.truths
    ratio = case.facts["misfit_over_noise"]
    assert 1.0 <= ratio <= 2.0
    assert max(2.0, 3.0 * ratio) <= truth.trace <= 30.0
    assert max(2.0, 1.5 * ratio) <= truth.trace_beyond <= truth.trace
    drift = truth.parameters["d_K_per_s"] * case.record.time_s[: int(0.7 * case.record.time_s.size)]
    n = len([name for name in case.record.values if name.startswith("T_")]) - sum(
        b.channel is not None for b in case.spec.boundaries.values()
    )
    n += case.facts["unread"] is not None
    assert truth.trace == pytest.approx(np.sqrt(np.mean(drift**2) / n) / case.noise_K, rel=1e-6)
    fit = fit_trajectories(case.spec, [case.record])
    assert fit.optimum.status == "converged"
