"""What a node stores beyond its declared capacity."""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import ndtr

from benchmarks.worlds.hidden.base import Draft, Effect, Scene
from benchmarks.worlds.stepping import Acting


def capacity_temperature(s: Scene) -> Draft:
    """Draw a capacity that changes with temperature."""
    node, sign = s.node(), s.sign()
    own = s.craft.field.shares[node] * s.craft.field.node_capacity_J_per_K[node]
    low, high = s.quantiles(node, 0.0, 1.0)
    reference, reach = 0.5 * (low + high), 0.5 * (high - low) + 3.0

    def make(kappa: float) -> Effect:
        k = sign * kappa
        acting = Acting(
            stored_J=lambda x: 0.5 * k * own * (x[: own.size] - reference) ** 2,
            slope_J_per_K=lambda x: k * own * (x[: own.size] - reference),
        )
        return Effect({"node": node}, {"kappa_per_K": k, "T_ref_K": reference}, acting)

    return Draft(make, 0.3 / reach, 0.03 / reach, 0.8 / reach)


def latent_heat(s: Scene) -> Draft:
    """Draw a phase change within the visited range, spread over the node."""
    node = s.node()
    share, capacity = s.craft.field.shares[node], s.craft.field.node_capacity_J_per_K[node]
    low, high = s.quantiles(node, 0.15, 0.85)
    centre, width = float(s.rng.uniform(low, high)), float(s.rng.uniform(0.4, 1.5))

    def make(per_capacity_K: float) -> Effect:
        size = per_capacity_K * capacity
        acting = Acting(
            stored_J=lambda x: size * share * ndtr((x - centre) / width),
            slope_J_per_K=lambda x: (
                size * share * np.exp(-0.5 * ((x - centre) / width) ** 2) / (width * np.sqrt(2 * np.pi))
            ),
        )
        return Effect({"node": node}, {"L_J": size, "T_m_K": centre, "w_K": width}, acting)

    return Draft(make, 0.4 * (high - low), 0.1, 60.0)


def hidden_mass(s: Scene) -> Draft:
    """Draw a mass behind a spot that nobody declared."""
    node = s.node()
    spot, capacity = s.spot(node), s.craft.field.node_capacity_J_per_K[node]
    lag_s = max(float(s.rng.uniform(0.15, 0.8)) * min(s.craft.orbit.period_s, 10_000.0), 6.0 * s.craft.sample_s)

    def make(ratio: float) -> Effect:
        mass, g = ratio * capacity, ratio * capacity / lag_s
        jump = csr_matrix(np.concatenate([spot, [-1.0]]))
        acting = Acting(stiffness_W_per_K=csr_matrix(g * (jump.T @ jump)), mass_J_per_K=mass)
        return Effect({"node": node}, {"C_J_per_K": mass, "G_W_per_K": g}, acting)

    return Draft(make, 0.8, 0.2, 2.5)
