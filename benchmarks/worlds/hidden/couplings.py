"""What joins two nodes beyond the declaration, or changes a contact."""

import numpy as np
from scipy.sparse import csr_matrix

from benchmarks.worlds.hidden.base import Draft, Effect, Scene, heated
from benchmarks.worlds.stepping import SIGMA_W_PER_M2_K4, Acting, Moment


def radiative_exchange(s: Scene) -> Draft:
    """Draw two faces that see each other."""
    a, b = s.pair(joined=False)
    here, there = s.spot(a), s.spot(b)

    def make(area: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            fourth = x**4
            flow = here * (there @ fourth - fourth) + there * (here @ fourth - fourth)
            return SIGMA_W_PER_M2_K4 * area * flow

        return heated({"nodes": [a, b]}, {"R_m2": area}, heat)

    return Draft(make, 0.1, 0.0, 0.6)


def missing_conductor(s: Scene) -> Draft:
    """Draw a strap between two spots."""
    a, b = s.pair(joined=False)
    jump = csr_matrix(s.spot(a) - s.spot(b))

    def make(g: float) -> Effect:
        acting = Acting(stiffness_W_per_K=csr_matrix(g * (jump.T @ jump)))
        return Effect({"nodes": [a, b]}, {"G_W_per_K": g}, acting)

    return Draft(make, 0.5, 0.0, 20.0)


def conductance_step(s: Scene) -> Draft:
    """Draw a contact that changes at an instant."""
    (a, b), sign, onset = s.pair(joined=True), s.sign(), s.onset()
    own = s.craft.field.between[a, b]

    def make(d: float) -> Effect:
        f = float(np.exp(sign * d))
        acting = Acting(stiffness_W_per_K=csr_matrix((f - 1.0) * own), onset_s=onset)
        return Effect({"nodes": [a, b]}, {"f": f, "time": onset}, acting, onset_s=onset)

    return Draft(make, 0.7, 0.1, 2.5)


def conductance_temperature(s: Scene) -> Draft:
    """Draw a contact that conducts better or worse when it is warm."""
    (a, b), sign = s.pair(joined=True), s.sign()
    own, shares = s.craft.field.between[a, b], s.craft.field.shares
    mean = 0.5 * (shares[a] + shares[b])
    reference = float(np.mean([s.quantiles(n, 0.5)[0] for n in (a, b)]))

    def make(beta: float) -> Effect:
        def heat(m: Moment, x: np.ndarray) -> np.ndarray:
            return -max(sign * beta * float(mean @ x - reference), -0.9) * (own @ x)

        return heated({"nodes": [a, b]}, {"beta_per_K": sign * beta, "T_ref_K": reference}, heat)

    return Draft(make, 0.02, 0.004, 0.06)
