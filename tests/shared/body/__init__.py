"""Tests of `shared.body`."""
