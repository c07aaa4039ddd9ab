"""Parameters, their transforms and priors, and the flat vector that a solver sees."""
