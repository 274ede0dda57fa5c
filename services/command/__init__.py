"""The `penumbra` command: its entry point, and the commands that look at or steer a running cell."""
