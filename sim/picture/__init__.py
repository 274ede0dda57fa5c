"""The pictures of the simulated cameras."""
