"""The services: one folder per process, the launcher and the `penumbra` command."""
