"""Tests of `services.camera`."""
