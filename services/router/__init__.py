"""The meeting point of a host's processes: a Zenoh session in router mode. Nothing is computed here.

`penumbra up` holds one inside the launcher; `penumbra router` is one on its own, for containers and for hosts that are linked.
"""
