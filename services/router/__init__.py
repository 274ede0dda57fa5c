"""The meeting point of a host's processes: a Zenoh session in router mode. Nothing is computed here.

`penumbra up` starts one, of which it is a client as all the others are; in containers, and for hosts that are linked, it is
started for itself.
"""
