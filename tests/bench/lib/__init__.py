"""What the benchmarks share: baselines, bounds, campaigns, pictures."""
