"""Tests of `services.ros2`."""
