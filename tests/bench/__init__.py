"""Benchmarks, run by `penumbra bench NAME`: each prints a table beside its bound and writes JSON."""
