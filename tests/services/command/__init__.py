"""Tests of `services.command`."""
