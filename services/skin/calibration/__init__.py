"""Recordings of a real or emulated pad, the response laws fitted to them, and a pad's characterisation."""
