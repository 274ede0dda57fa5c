"""Tests of `shared.geometry`."""
