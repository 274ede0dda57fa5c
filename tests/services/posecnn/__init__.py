"""Tests of `services.posecnn`."""
