"""The Python client. Poses come out of a running cell as numpy arrays; images, joint angles and voltages go in.

`connect.py` finds the router and the cell, `cell.py` is the object that a program then holds, `poses.py` waits for poses,
`publish.py` checks and sends measurements, `aio.py` is all of it for `async` programs. The client needs none of the libraries of
the services.
"""
