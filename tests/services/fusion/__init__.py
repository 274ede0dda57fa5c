"""Tests of `services.fusion`."""
