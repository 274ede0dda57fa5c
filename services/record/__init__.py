"""Records what the bus carries to MCAP files: every topic as it is, beside what Foxglove and Rerun show of it.

With --last it keeps the last seconds in memory instead, and writes them when it is asked to (`penumbra record save`) or when a
target is lost.
"""
