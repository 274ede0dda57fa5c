"""Plays what was recorded: onto the bus, in place of sensors or of everything, or through the methods in one process, or makes
of its poses the best trajectory afterwards."""
