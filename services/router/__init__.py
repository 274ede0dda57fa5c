"""The meeting point of all processes: a Zenoh session in router mode. Nothing is computed here.

`penumbra up` holds one inside the launcher; `penumbra router` is one on its own, for containers and several machines.
"""
