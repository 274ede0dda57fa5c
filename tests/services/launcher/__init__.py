"""Tests of `services.launcher`."""
