"""Pictures, films and trials with their truth, for training and for benchmarks."""
