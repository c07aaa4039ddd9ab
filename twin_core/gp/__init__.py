"""Gaussian processes as state-space models: kernels, discretisation, Kalman filter and smoother."""
