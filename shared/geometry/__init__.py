"""Rigid-body geometry, rasterisation of triangle meshes, and distances to them."""
