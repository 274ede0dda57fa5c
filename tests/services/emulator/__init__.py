"""Tests of `services.emulator`."""
