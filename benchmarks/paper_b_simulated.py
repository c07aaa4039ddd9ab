"""Section IV-A of Kouw et al. (CCTA 2024), exactly as printed: three blocks, a cubic loss, a thousand seconds.

Conductances 10 W/K, 1000 J/K per block, ambient 21 degC, linear convection 2 W/K, 100 W into block 1 from 100 s on,
r = (T_a - T)^3 / 100, noise variance 1e-3, prior N(21, 1); tested from 25 degC with 100 W from 120 to 600 s.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from numpy.polynomial import Polynomial
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from twin_core._typing import FloatArray, IntArray
from twin_core.gp.discretise import discretise
from twin_core.gp.kalman import kalman_filter
from twin_core.gp.kernels import Kernel, Matern, Values
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.gp.smoother import smooth
from twin_core.gp.state_space import LinearModel
from twin_core.latent_force.hyperparameters import MapFit, fit_map
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.polynomial import regress_pointwise
from twin_core.latent_force.posterior import GammaPrior, Posterior
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.latent_force.smooth import LatentForce, smooth_force

AMBIENT, CAPACITY, NOISE_VARIANCE, HEAT_W = 21.0, 1000.0, 1e-3, 100.0
CONDUCTION = 10.0 * np.array([[-1.0, 1.0, 0.0], [1.0, -2.0, 1.0], [0.0, 1.0, -1.0]])
LINEAR = CONDUCTION - 2.0 * np.eye(3)
TIMES = np.arange(1000.0)
PAPER_KERNEL = Matern(1, decay=float(np.sqrt(3.0)))
PRIORS = {"std": GammaPrior(5.0, 0.1), "length_s": GammaPrior(5.0, 0.1)}
START = {"std": (3.0, 20.0), "length_s": (30.0, 300.0)}
LATE_START = {"std": 4.0, "length_s": 300.0}
PUBLISHED_STD_W = 20.0
"""Around which the paper's figure 3 shows the posterior of the force's standard deviation."""
HeatFlow = Callable[[FloatArray], FloatArray]


def true_heat_W(temperature: FloatArray) -> FloatArray:
    """Return the hidden convection r, in W."""
    return (AMBIENT - temperature) ** 3 / 100.0


def simulate(start: float, on_s: float, off_s: float, extra_K_per_s: HeatFlow) -> FloatArray:
    """Integrate the three blocks to 1e-9 K, switching instants hit exactly; (1000, 3) in degC."""
    edges = [0.0, on_s, min(off_s, TIMES[-1]), TIMES[-1]]
    state, out = np.full(3, start), np.full((TIMES.size, 3), start)
    for k, (left, right) in enumerate(itertools.pairwise(edges)):
        heat = np.array([HEAT_W if k == 1 else 0.0, 0.0, 0.0])
        inside = (TIMES > left) & (TIMES <= right)
        if right <= left:
            continue
        run = solve_ivp(
            lambda _, x, heat=heat: (LINEAR @ x + 2.0 * AMBIENT + heat) / CAPACITY + extra_K_per_s(x),
            (left, right),
            state,
            t_eval=TIMES[inside],
            rtol=1e-9,
            atol=1e-9,
        )
        out[inside], state = run.y.T, run.y[:, -1]
    return out


TRAIN = simulate(AMBIENT, 100.0, np.inf, lambda x: true_heat_W(x) / CAPACITY)
TEST = simulate(25.0, 120.0, 600.0, lambda x: true_heat_W(x) / CAPACITY)


@dataclass(frozen=True)
class PrintedModel(ForceModel):
    """The block model with the noise integral as the paper prints it: eqs. 15a and 15b carry M⁻¹, not M⁻² in Q11."""

    def _assemble(self, values: Values, network: Linearised, steps: FloatArray, index: IntArray) -> tuple[Values, ...]:
        transition, q, *rest = super()._assemble(values, network, steps, index)
        printed = q.copy()
        n = self.n_nodes
        printed[:, range(n), range(n)] *= CAPACITY
        return transition, printed, *rest


def force_model(kernel: Kernel, *, printed: bool = False, shared: bool = True) -> ForceModel:
    """Return the paper's model over the training record."""
    inputs = np.full((TIMES.size - 1, 2, 3), 2.0 * AMBIENT)
    inputs[TIMES[:-1] >= 100.0, :, 0] += HEAT_W
    network = Linearised(TIMES, LINEAR[None] / CAPACITY, inputs / CAPACITY, np.full((1, 3), CAPACITY))
    kind = PrintedModel if printed else ForceModel
    return kind.build(
        network,
        (0, 1, 2),
        kernel,
        observation=np.eye(3),
        noise_std_K=np.full(3, np.sqrt(NOISE_VARIANCE)),
        prior_mean_K=np.full(3, AMBIENT),
        prior_std_K=1.0,
        shared=shared,
        scheme="first-order" if printed else "exact",
    )


@dataclass
class Tally:
    """What one method gave over the seeds."""

    mse_K2: list[float] = field(default_factory=list)
    curve_coverage: list[float] = field(default_factory=list)
    force_coverage: list[float] = field(default_factory=list)
    fits: list[MapFit] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    nats_at_published: list[float] = field(default_factory=list)

    def add_curve(self, polynomials: Sequence[ForcePolynomial], boundary: FloatArray) -> None:
        """Note simulation error and how much of the true curve the 90 % band covers over the visited range."""
        self.mse_K2.append(_simulation_mse(polynomials))
        covered = []
        for node, polynomial in enumerate(polynomials):
            heat = polynomial.predict(TRAIN[:, node], boundary)
            covered.append(np.abs(heat.mean_W - true_heat_W(TRAIN[:, node])) < 1.6449 * heat.std_W)
        self.curve_coverage.append(float(np.mean(covered)))

    def add_force(self, force: LatentForce) -> None:
        """Note how much of the true heat over time the smoothed force's 90 % band covers."""
        covered = np.abs(force.mean_W - true_heat_W(TRAIN)) < 1.6449 * force.std_W
        self.force_coverage.append(float(np.mean(covered)))


def _simulation_mse(polynomials: Sequence[ForcePolynomial]) -> float:
    """Simulate the test with the learned mean, held at its edges; return the mean squared error, K²."""

    def extra(x: FloatArray) -> FloatArray:
        return np.array([p.heat_W(t, AMBIENT) for t, p in zip(x, polynomials, strict=True)]) / CAPACITY

    return float(np.mean((simulate(25.0, 120.0, 600.0, extra) - TEST) ** 2))


def residual_polynomial_mse(samples: FloatArray) -> float:
    """The paper's comparison: smooth without the hidden heat, fit a cubic to y - m, use it as a rate in K/s."""
    model = force_model(PAPER_KERNEL)
    network = model.network(np.zeros(0))
    euler = discretise(network.jacobian_per_s[0], np.zeros((3, 3)), np.ones(1), scheme="first-order")
    linear = LinearModel.build(
        transition=np.real(euler.transition),
        process_cov=1e-8 * np.eye(3),
        offset=np.real(network.constant_K_per_s[:, 0]),
        observation=np.eye(3),
        noise_variance=model.noise_std_K**2,
        prior_mean=model.prior_mean_K,
        prior_cov=np.eye(3),
        n_times=TIMES.size,
    )
    mean = smooth(linear, kalman_filter(linear, samples), keep_cov=False).mean
    curves = [Polynomial.fit(mean[:, k], samples[:, k] - mean[:, k], 3) for k in range(3)]
    simulated = simulate(25.0, 120.0, 600.0, lambda x: np.array([c(t) for t, c in zip(x, curves, strict=True)]))
    return float(np.mean((simulated - TEST) ** 2))


def run_seed(seed: int, tallies: dict[str, Tally]) -> None:
    """Run every method on one draw of the noise."""
    samples = TRAIN + np.sqrt(NOISE_VARIANCE) * np.random.default_rng(seed).normal(size=TRAIN.shape)
    boundary = np.full(TIMES.size, AMBIENT)
    fits: dict[str, tuple[ForceModel, MapFit]] = {}
    for name, kernel in (("matern-1/2", PAPER_KERNEL), ("matern-3/2", Matern(3)), ("matern-5/2", Matern(5))):
        model, tally = force_model(kernel), tallies[name]
        begin = process_time()
        fit = fit_map(model, samples, PRIORS, START)
        tally.seconds.append(process_time() - begin)
        force = smooth_force(model, samples, fit.values)
        tally.fits.append(fit)
        tally.add_force(force)
        learned = learn_heat_flow(model, samples, fit.values, force, boundary_K=boundary)
        tally.add_curve(learned.polynomials, boundary)
        fits[name] = (model, fit)
        if name == "matern-1/2":
            tallies["pointwise"].add_curve(_pointwise(force, boundary), boundary)
    best = max(fits, key=lambda name: fits[name][1].log_posterior)
    for kind in ("mse_K2", "curve_coverage", "force_coverage"):
        getattr(tallies["by evidence"], kind).append(getattr(tallies[best], kind)[-1])
    _other_posteriors(samples, fits["matern-1/2"], tallies)
    _run_printed(samples, boundary, tallies["printed"])
    tallies["residual"].mse_K2.append(residual_polynomial_mse(samples))


def _other_posteriors(samples: FloatArray, ours: tuple[ForceModel, MapFit], tallies: dict[str, Tally]) -> None:
    """Note the hyperparameters without a prior and one set per block, and what the published size costs."""
    model, fit = ours
    tallies["flat"].fits.append(fit_map(model, samples, {}, START))
    apart = force_model(PAPER_KERNEL, shared=False)
    priors, start = ({f"{k}[{node}]": v for node in range(3) for k, v in d.items()} for d in (PRIORS, LATE_START))
    tallies["separate"].fits.append(fit_map(apart, samples, priors, start))
    posterior = Posterior(model, samples, PRIORS)
    found = minimize_scalar(
        lambda log_length: -posterior.value(np.array([np.log(PUBLISHED_STD_W), log_length])), bounds=(1.0, 11.0)
    )
    tallies["matern-1/2"].nats_at_published.append(fit.log_posterior + float(found.fun))


def _run_printed(samples: FloatArray, boundary: FloatArray, tally: Tally) -> None:
    """Run the paper's own method: printed approximations, pointwise cubic."""
    model = force_model(PAPER_KERNEL, printed=True)
    fit = fit_map(model, samples, PRIORS, START)
    force = smooth_force(model, samples, fit.values)
    tally.fits.append(fit)
    tally.add_force(force)
    tally.add_curve(_pointwise(force, boundary), boundary)


def _pointwise(force: LatentForce, boundary: FloatArray) -> list[ForcePolynomial]:
    """Fit the paper's third-order regression: three weights each, on powers of T - T_a, flat prior."""
    return [
        regress_pointwise(
            force.temperature_K[:, k],
            force.mean_W[:, k],
            force.std_W[:, k],
            degree=3,
            boundary_K=boundary,
            vanishing=True,
        )
        for k in range(3)
    ]


def run(seeds: Sequence[int]) -> dict[str, Tally]:
    """Run all seeds; method -> tally. ``none`` simulates without any learned heat."""
    names = ("matern-1/2", "matern-3/2", "matern-5/2", "by evidence", "pointwise", "printed", "residual", "none")
    names += ("flat", "separate")
    tallies = {name: Tally() for name in names}
    for seed in seeds:
        run_seed(seed, tallies)
    without = simulate(25.0, 120.0, 600.0, lambda x: np.zeros(3))
    tallies["none"] = replace(tallies["none"], mse_K2=[float(np.mean((without - TEST) ** 2))])
    return tallies
