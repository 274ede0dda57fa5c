"""The meeting point of all processes: a Zenoh session in router mode. Nothing is computed here.

`penumbra up` starts one, of which it is a client as all the others are; in containers and on several machines it is started for
itself.
"""
