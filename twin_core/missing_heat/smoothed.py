"""The heat that the declared model lacks, smoothed: a Gaussian process that knows no effect, beside what was found.

The search weighs named effects against each other. The latent force knows none of them: it takes the declared network at
its fitted parameters and smooths whatever heat must have flowed into the nodes for the readings to be what they are
(Kouw et al., CCTA 2024, eqs. 5-29). Where both tell the same, a finding does not hang on the search alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin_core._typing import FloatArray, Json
from twin_core.calibrate.containment import NO_DEADLINE, TimeIsUpError, check_time, is_late, limited
from twin_core.calibrate.identifiability import gone_far
from twin_core.calibrate.undeclared.model import HeatFit, Nominal, floor_K2, states_of
from twin_core.discover.judge import Search
from twin_core.discover.trial import Trial, about_trajectory
from twin_core.errors import TwinError
from twin_core.gp.kernels import Matern
from twin_core.gp.polynomial import ForcePolynomial
from twin_core.latent_force.declared import declared_model
from twin_core.latent_force.linearised import Linearised
from twin_core.latent_force.model import ForceModel
from twin_core.latent_force.network import linearise_network, on_grid
from twin_core.latent_force.regression import learn_heat_flow
from twin_core.latent_force.smooth import LatentForce, smooth_extended
from twin_core.missing_heat.drivers import followed
from twin_core.missing_heat.effect_heat import effect_heat, nodes_of_interest
from twin_core.network.dynamics import fill_boundaries, reading_offsets_K
from twin_core.network.model import Network
from twin_core.simulate.forcing import Forcing

MAX_WORK = 2e6
"""Steps times squared states that are smoothed at most: of a longer record, its end."""
MAX_LINEARISATIONS = 3
MAX_DEGREE = 4
MAX_TERMS_WORK = 1e7
"""Steps times squared states times polynomial terms beyond which heat over temperature is left to the plotted points."""
SMALLEST_SHARE = 0.02
"""Size of the latent force on a node of interest at least, as a share of the heat that passes through the node. What the
calibration sized to nothing elsewhere carries no force at all."""
CORRELATED, ALIKE = 0.8, 0.5
"""Correlation from which, and rms difference (as a share of the effect's heat) up to which, both witnesses agree."""
REPEATABLE = 0.5
"""Share of a missing heat that must come back with something for it to be called repeatable."""
BAND = 2.0
"""Standard deviations within which a difference is no disagreement, and below which a heat is not seen."""


@dataclass(frozen=True)
class NodeHeat:
    """The missing heat at one node.

    Attributes
    ----------
    node
        Its name.
    time_s : (n_steps,)
        Ends of the steps.
    temperature_K, mean_W, std_W : (n_steps,)
        Smoothed temperature and missing heat.
    effect_W : (n_steps,), optional
        What the findings say that it is.
    law
        The missing heat over temperature; None where the data do not support that it repeats with temperature.
    turnover_W
        Mean heat that passes through the node: half of all flows' magnitudes.
    follows
        What the missing heat comes back with -> share of its variance that this predicts, the largest first.
    """

    node: str
    time_s: FloatArray
    temperature_K: FloatArray
    mean_W: FloatArray
    std_W: FloatArray
    effect_W: FloatArray | None
    law: ForcePolynomial | None
    turnover_W: float
    follows: Mapping[str, float]

    @property
    def band_W(self) -> float:
        """Root mean square of the standard deviation."""
        return _rms(self.std_W)

    @property
    def _varies(self) -> bool:
        """Whether the missing heat is seen to vary: by more than its own uncertainty."""
        return bool(self.mean_W.std() > self.band_W)

    @property
    def correlation(self) -> float | None:
        """Correlation of the findings' heat with the missing heat; None where either is constant or there is none."""
        if self.effect_W is None or min(np.ptp(self.effect_W), np.ptp(self.mean_W)) <= 1e-9 * _rms(self.mean_W):
            return None
        return float(np.corrcoef(self.effect_W, self.mean_W)[0, 1])

    @property
    def agrees(self) -> bool | None:
        """Whether the findings' heat is the missing heat; None without one, or where the band is wider than it.

        Where the missing heat is seen to vary and the findings' does, they must repeat it too.
        """
        if self.effect_W is None or _rms(self.effect_W) < BAND * self.band_W:
            return None
        if not self._varies or self.correlation is None:
            return self._is_alike
        return self.correlation >= (REPEATABLE**0.5 if self._is_alike else CORRELATED)

    @property
    def _is_alike(self) -> bool:
        """Whether both heats are the same in size."""
        if self.effect_W is None:
            return False
        apart = _rms(self.effect_W - self.mean_W)
        return apart <= max(ALIKE * _rms(self.effect_W), BAND * self.band_W)

    def _variation(self) -> str:
        """Return in words how the heat varies and with what; heat that several things drive together follows none alone."""
        if not self._varies:
            return f"no variation beyond the uncertainty of {self.band_W:.2g} W is seen"
        return f"this varies by {self.mean_W.std():.2g} W (uncertainty {self.band_W:.2g} W), and {self._following()}"

    def _following(self) -> str:
        what, share = next(iter(self.follows.items()), ("nothing", 0.0))
        if share < REPEATABLE:
            most = f" (at most {share:.0%} of it, the {what})" if share >= 0.01 else ""
            return f"no temperature, difference of temperatures, channel or period by itself foretells that variation{most}"
        return f"{share:.0%} of that variation follows the {what}"

    def row(self) -> Json:
        """Return the figures for a report."""
        return {
            "node": self.node,
            "mean_W": float(self.mean_W.mean()),
            "std_W": self.band_W,
            "share_of_turnover": _rms(self.mean_W) / self.turnover_W if self.turnover_W > 0 else None,
            "effect_mean_W": None if self.effect_W is None else float(self.effect_W.mean()),
            "effect_share_of_turnover": None
            if self.effect_W is None or self.turnover_W <= 0
            else _rms(self.effect_W) / self.turnover_W,
            "correlation_with_effect": self.correlation,
            "agrees": self.agrees,
            "follows": [{"what": what, "share": share} for what, share in self.follows.items() if self._varies],
        }

    def words(self, *, no_heat: bool = False) -> str:
        """Return what it says in a few sentences; ``no_heat``: what was found supplies none, such as a sensor that lags."""
        mean = self.mean_W.mean()
        if no_heat:
            varies = f" and vary by {self.mean_W.std():.2g} W" if self._varies else ""
            return (
                f"Were what the readings at {self.node} show a heat, it would be {mean:.3g} W on average{varies} "
                f"(uncertainty {self.band_W:.2g} W); what was found explains the readings without one."
            )
        lacks = f"lacks {mean:.3g} W at {self.node}" if mean >= 0.0 else f"has {-mean:.3g} W too much at {self.node}"
        seen = f"The declared model {lacks} on average; {self._variation()}."
        if self.effect_W is None:
            return seen
        supplied = self.effect_W.mean()
        verdict = {
            True: "the two agree"
            if self._is_alike
            else "the two rise and fall together, and declared parameters had taken up a part",
            False: "the two are alike in size but do not vary together"
            if self._is_alike
            else "the two differ, as they do where declared parameters had taken up a part of that heat",
            None: "the uncertainty is too wide to compare them",
        }[self.agrees]
        said = f"supply {supplied:.3g} W" if supplied >= 0.0 else f"take {-supplied:.3g} W away"
        alike = "" if self.correlation is None or not self._varies else f" (correlation {self.correlation:.2f})"
        return f"{seen} The findings {said} there: {verdict}{alike}."


@dataclass(frozen=True)
class MissingHeat:
    """The nodes of interest, what could not be told, in words, and whether what was found supplies no heat at any node."""

    heats: tuple[NodeHeat, ...]
    notices: tuple[str, ...] = ()
    no_heat: bool = False

    def rows(self) -> list[Json]:
        """Return the figures for a report, one row per node."""
        return [heat.row() for heat in self.heats]

    def words(self) -> list[str]:
        """Return one sentence per node; none of a node at which no heat at all is missing, as where nothing reaches it."""
        return [heat.words(no_heat=self.no_heat) for heat in self.heats if heat.mean_W.any()]


def not_in_report(what: str, error: Exception) -> str:
    """Return the notice that a part of the report could not be computed, and why."""
    if isinstance(error, TimeIsUpError):
        why = "the deadline was reached before it was computed; allow more time"
    else:
        why = f"its computation failed ({str(error) or type(error).__name__})"
    return f"the report does not contain {what}: {why}"


def smooth_missing_heat(search: Search, *, deadline: float = NO_DEADLINE) -> MissingHeat:
    """Smooth the missing heat at the nodes of interest of the declared model, over the last training segment.

    Trouble with the numbers is told in the notices, never raised: the finding stands without it.

    Parameters
    ----------
    search
        A finished search; its base is the declared model.
    deadline
        On the clock of ``time.monotonic``: without time left there are no heats, and a notice.
    """
    nodes = nodes_of_interest(search)
    try:
        with limited(deadline):
            check_time()
            fit = _as_told(search.base)
            force, model, observations, values, view = smoothed_force(fit, nodes)
    except (TwinError, ArithmeticError, np.linalg.LinAlgError, TimeIsUpError) as error:
        return MissingHeat((), (not_in_report(f"the missing heat at {', '.join(nodes)}", error),))
    network = fit.network
    watched = [force.nodes.index(network.nodes.index(node)) for node in nodes]
    laws, notices = ({}, []) if is_late(deadline) else _laws(model, observations, values, force, watched)
    if view.first_step > 0:
        notices.append(
            f"missing heat: smoothed over the last {np.ptp(force.time_s):.0f} s of the training record alone"
        )
    states = force.temperature_K[1:]
    effect, turnover = effect_heat(search, states, view.first_step), view.turnover_W(network, states)
    heats = []
    for node, k in zip(nodes, watched, strict=True):
        at = force.nodes[k]
        mean, std = force.mean_W[1:, k], force.std_W[1:, k]
        if not (np.isfinite(mean).all() and np.isfinite(std).all()):
            notices.append(f"missing heat at {node}: the latent force is not finite")
            continue
        said = None if effect is None or np.isnan(effect[:, at]).any() else effect[:, at]
        time_s = view.forcing.stage_time_s[:, 1]
        boundaries = view.moving_boundaries_K(network)
        drivers = {f"temperature of {name}": series for name, series in {node: states[:, at], **boundaries}.items()}
        others = {name: states[:, i] for i, name in enumerate(network.nodes) if i != at}
        follows = followed(
            time_s, mean, {**drivers, **view.channels()}, own_K=states[:, at], others_K={**others, **boundaries}
        )
        heats.append(NodeHeat(node, time_s, states[:, at], mean, std, said, laws.get(at), float(turnover[at]), follows))
    no_heat = bool(search.findings) and not (effect is not None and np.nan_to_num(effect).any())
    return MissingHeat(tuple(heats), tuple(notices), no_heat)


def _as_told(base: Trial) -> HeatFit:
    """Return the declared model beside undeclared heat, at about the parameters that the report tells.

    Beside heat of any size parameters give way to what is missing, and so tell it best. Where guesses are far off they may take
    a scale of their own as well, on which the declared heat does not count: then the heat would be told of another model.
    """
    told, beside_heat = base.calibration(), base.fit.network.parameters.as_dict()
    far = gone_far(told.network.parameters, beside_heat)
    return about_trajectory(told.problem, told.optimum) if far else base.fit


def added_to_report(missing: MissingHeat, report: Json) -> Json:
    """Return what the missing heat adds to a report: its figures, its sentences after the words, its notices after the others."""
    return {
        "missing_heat": missing.rows(),
        "words": [*report["words"], *missing.words()],
        "notices": [*report["notices"], *missing.notices],
    }


@dataclass(frozen=True)
class View:
    """The steps of a segment that are smoothed: ``forcing`` begins at its step ``first_step``."""

    forcing: Forcing
    first_step: int

    @classmethod
    def of(cls, forcing: Forcing, n_states: int) -> "View":
        """Return the end of a forcing that is not too much work."""
        first = max(0, forcing.n_steps - max(int(MAX_WORK / n_states**2), 2))
        at = forcing.sample_step
        window = replace(
            forcing,
            start_s=forcing.start_s if first == 0 else float(forcing.stage_time_s[first - 1, 1]),
            step_s=forcing.step_s[first:],
            stage_time_s=forcing.stage_time_s[first:],
            sample_step=at[at >= first] - first,
            boundaries_K=forcing.boundaries_K[first:],
            inputs={name: series[first:] for name, series in forcing.inputs.items()},
            sun_factor=forcing.sun_factor[first:],
        )
        return cls(window, first)

    def moving_boundaries_K(self, network: Network) -> dict[str, FloatArray]:
        """Return the temperatures of boundaries that move, in K at the ends of the steps, by name, (n_steps,) each.

        The difference to one that stands still tells nothing that the node's own temperature does not.
        """
        ends = self.forcing.boundaries_K[:, 1]
        return {name: ends[:, i] for i, name in enumerate(network.spec.boundaries) if np.ptp(ends[:, i]) > 0.0}

    def channels(self) -> dict[str, FloatArray]:
        """Return inputs and auxiliary channels that move, in SI at the ends of the steps, by name, (n_steps,) each."""
        ends = {f"channel {name}": series[:, 1] for name, series in self.forcing.inputs.items()}
        return {name: series for name, series in ends.items() if np.ptp(series) > 0.0}

    def turnover_W(self, network: Network, states_K: FloatArray) -> FloatArray:
        """Return the mean heat that passes through each node at the ends of the steps, (n_nodes,)."""
        forcing, values = self.forcing, network.parameters.values
        boundaries = fill_boundaries(network, values, forcing.boundaries_flat_K(0, forcing.n_steps))
        along = forcing.along(np.repeat(states_K, 2, axis=0), boundaries, 0, forcing.n_steps)
        total = np.zeros(states_K.shape[1])
        for term in network.terms:
            part = term.evaluate(along, values[network.term_index(term)])
            np.add.at(total, list(part.nodes), 0.5 * np.abs(part.heat_W[1::2]).mean(axis=0))
        return total


def smoothed_force(
    fit: HeatFit, nodes: Sequence[str]
) -> tuple[LatentForce, ForceModel, FloatArray, FloatArray, "View"]:
    """Return the smoothed forces, their model about the smoothed temperatures, readings, hyperparameters and steps."""
    nominal, network = fit.nominals[-1], fit.network
    view = View.of(nominal.segment.forcing, 2 * len(network.nodes))
    states = states_of(nominal)[view.first_step :]
    turnover = view.turnover_W(network, states[1:])
    watched = [network.nodes.index(node) for node in nodes]
    std = fit.undeclared.std_W.copy()
    std[watched] = np.maximum(std[watched], np.maximum(SMALLEST_SHARE * turnover[watched], 1e-6))
    at = [i for i in range(std.size) if i in watched or std[i] > 1e-4 * turnover[i]]
    linearised = linearise_network(network, view.forcing)

    def about(states_K: FloatArray) -> Linearised:
        check_time()
        return linearised(states_K)

    model = _model(fit, nominal, view, at, states)
    values = np.ravel([[std[i], fit.undeclared.length_s] for i in at])
    readings = _readings(network, nominal)[nominal.segment.forcing.sample_step >= view.first_step]
    observations = on_grid(view.forcing, readings)
    force = smooth_extended(model, about, observations, values, max_linearisations=MAX_LINEARISATIONS)
    final = about(force.temperature_K)
    return force, replace(model, network=lambda _: final), observations, values, view


def _model(fit: HeatFit, nominal: Nominal, view: View, at: Sequence[int], states_K: FloatArray) -> ForceModel:
    """Return the declared network with a Matérn-1/2 force (the paper's) on some nodes."""
    network, segment = fit.network, nominal.segment
    return declared_model(
        network,
        view.forcing,
        states_K,
        [network.nodes[i] for i in at],
        Matern(1),
        noise_std_K=fit.problem.noise_K,
        prior_mean_K=segment.start_prior_K if view.first_step == 0 else states_K[0],
        prior_std_K=segment.start_std_K,
        shared=False,
        drift_K2_per_s=floor_K2(fit.problem) / float(np.median(view.forcing.step_s)),
    )


def _readings(network: Network, nominal: Nominal) -> FloatArray:
    """Return the measured temperatures without the network's own reading faults, (n_samples, n_sensors)."""
    offset_K = reading_offsets_K(network, network.parameters.values, nominal.segment.record.clock_s)
    return nominal.segment.measured_K - offset_K


def _laws(
    model: ForceModel, observations: FloatArray, values: FloatArray, force: LatentForce, watched: Sequence[int]
) -> tuple[dict[int, ForcePolynomial], list[str]]:
    """Return node -> polynomial of its temperature, where the evidence supports that the heat repeats with it."""
    n_states = model.n_nodes + len(model.forces)
    if force.time_s.size * n_states**2 * (MAX_DEGREE + 1) * len(watched) > MAX_TERMS_WORK:
        return {}, []
    try:
        learned = learn_heat_flow(model, observations, values, force, max_degree=MAX_DEGREE, only=watched)
    except (TwinError, ArithmeticError, np.linalg.LinAlgError) as error:
        return {}, [f"missing heat over temperature: no regression ({error})"]
    if not learned.log_bayes_factor > 0.0:
        return {}, []
    return {force.nodes[k]: law for k, law in zip(watched, learned.polynomials, strict=True)}, []


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
