"""Tests of `shared.native`."""
