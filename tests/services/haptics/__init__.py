"""Tests of `services.haptics`."""
