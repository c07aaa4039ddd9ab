"""Heat that nobody declared, seen as a Gaussian process in the heat balance: smoothing, hyperparameters, regression."""
