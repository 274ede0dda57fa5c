"""Helpers of tests and benchmarks: real processes, faults, networks, recordings."""
