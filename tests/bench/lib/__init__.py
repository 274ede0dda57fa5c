"""Common parts of the benchmarks: baselines, bounds, campaigns, pictures."""
