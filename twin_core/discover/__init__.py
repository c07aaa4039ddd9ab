"""The closed loop: residual, diagnosis, new model term, held-out error."""
