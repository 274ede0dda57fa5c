"""Tests of `services.skin`."""
