"""Undeclared heat on every node, as a Gaussian process: the model, the parameters fitted beside it, and its size."""
