"""Unit, replay, fault and live tests; tests/bench holds the benchmarks."""
