"""Tests of `services.robot`."""
