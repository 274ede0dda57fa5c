"""The whole chain as real processes, and as a replay."""
