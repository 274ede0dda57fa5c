"""Rigid-body geometry, triangle meshes as pictures, and distances to them."""
