"""Tests of `shared.skin`."""
