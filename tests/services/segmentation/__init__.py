"""Tests of `services.segmentation`."""
