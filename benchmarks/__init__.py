"""Benchmarks: what the claims of the documentation are measured with."""
