"""Policy: the thresholds by which the closed loop believes or disbelieves, and where each comes from.

What bounds only how much is looked at (how many candidates are fitted further, say) is a budget and stands where it is spent.
``make bench-ablation`` prints what every threshold does to a suite when it is off, half or double.
"""

from dataclasses import dataclass

LEAST_EXCESS = 0.1
DOMINANCE = 2.0
LEAST_COARSENESS = 0.5
MOST_COARSENESS = 4.0
VISIBLE_COARSENESS = 1.0
FORESIGHT = 0.97
BETWEEN_SESSIONS = 0.5
REPEATABLE_SHARE = 0.1
ALTERNATIVE_NATS = 3.0
LARGEST_NOISE = 1.5
LONE_CHANGE = 2.0
UNEXPLAINED_SHARE = 1.0


@dataclass(frozen=True)
class Threshold:
    """What a threshold of this module is.

    Attributes
    ----------
    unit
        Of its value.
    asks
        What it decides.
    origin
        Why it has this value.
    off, half, double
        Its values without the rule, and asking half and twice as much.
    """

    unit: str
    asks: str
    origin: str
    off: float
    half: float
    double: float


NOISE_VARIANCE = "variance of a sensor's noise"

THRESHOLDS: dict[str, Threshold] = {
    "LEAST_EXCESS": Threshold(
        NOISE_VARIANCE,
        "open-loop residuals above it at one sensor at least, or nothing is missing",
        "three standard errors of a variance told by some 2,000 readings: 3 sqrt(2 / 2000)",
        0.0,
        0.05,
        0.2,
    ),
    "DOMINANCE": Threshold(
        "ratio",
        "a name explains so many times what a lumped network may leave beside it, times so many times the share of variance that"
        " it leaves of what it was not fitted to where that is below one; or it foretells, and is likelier whatever the misfit is"
        " taken for, by so many times what chance makes of the log-likelihood of so many readings: sqrt(n / 2)",
        "a name that explains less than what stays could be the same coarseness; twice tells them apart within a factor sqrt 2",
        0.0,
        1.0,
        4.0,
    ),
    "LEAST_COARSENESS": Threshold(
        NOISE_VARIANCE,
        "what a network that is coarse at all counts as leaving beside gradients within nodes, as names may have soaked it up",
        "healthy finite-element spacecraft, whose misfit is one to two noises: beside gradients up to two thirds of one stay",
        0.0,
        0.25,
        1.0,
    ),
    "MOST_COARSENESS": Threshold(
        NOISE_VARIANCE,
        "what stays beyond it is no coarseness, and is not held against a name unless a far likelier option was refused,"
        " nor is an error up to it on what follows, however small it is without the name, nor a gain there that it may hide; of"
        " what gradients explain only the like share is theirs where more stays, and no more than it without a name unless as"
        " much with it; a repeatable heat that leaves more is not little unless so much else stays",
        "a misfit of two noises",
        1e12,
        2.0,
        8.0,
    ),
    "VISIBLE_COARSENESS": Threshold(
        "standard errors of the variance of that many readings",
        "what stays from which a network is taken to be coarse, wholly so from twice as much",
        "one standard error: what stays is a mean over sensors of what exceeds their noise, which chance alone makes positive",
        1e-12,
        0.5,
        2.0,
    ),
    "FORESIGHT": Threshold(
        "ratio",
        "error on what a finding was not fitted to, after over before, below it for each of its effects",
        "three per cent: what a leave-out over eight blocks varies by chance on healthy records",
        1e12,
        0.985,
        0.94,
    ),
    "BETWEEN_SESSIONS": Threshold(
        "share",
        "of what a law gains within sessions, so much is gained on sessions that it was not fitted to",
        "half: the other half may be what differs from session to session",
        -1e12,
        0.25,
        1.0,
    ),
    "REPEATABLE_SHARE": Threshold(
        "share of evidence, and of the variance that a name removes",
        "a name leaves no heat that repeats with temperature and is worth more than so much of its own evidence; up to as large a"
        " share of the misfit that the name removes, and of what stays, it is little, and up to its square of the former, less"
        " than stays, no objection at all; in a coarse network names that explain all"
        " but so much of what a finding explains are its alternatives",
        "a tenth: a law with a parameter of its own that is off by a third of its value leaves about as much",
        1e12,
        0.2,
        0.05,
    ),
    "ALTERNATIVE_NATS": Threshold(
        "nats",
        "names closer than this are told as alternatives, and the simplest of them leads",
        "odds of 20 to 1: positive evidence on the scale of Kass and Raftery (1995)",
        0.0,
        1.5,
        6.0,
    ),
    "LARGEST_NOISE": Threshold(
        "ratio",
        "noise that residuals show counts up to so many times what calibration took it to be; more is misfit",
        "noise told by few differences of readings is known to a third",
        1e12,
        1.25,
        2.0,
    ),
    "LONE_CHANGE": Threshold(
        "ratio",
        "an event is not named where an input's change is larger than so many times its largest change elsewhere",
        "two settings of one input tell a law from an event where the smaller change is half of the larger one",
        float("inf"),
        4.0,
        1.0,
    ),
    "UNEXPLAINED_SHARE": Threshold(
        "ratio of standard deviations",
        "misfit over noise beyond which a record without a finding is called unexplained",
        "a misfit as large as the noise",
        1e12,
        0.5,
        2.0,
    ),
}
"""At most twelve, each with its unit, its origin and what its ablation sets it to."""
