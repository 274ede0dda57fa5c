"""Tests of `services.dashboard`."""
