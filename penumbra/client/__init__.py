"""The Python client. It receives the poses of a running cell as numpy arrays, and publishes images, joint angles and voltages.

`connect.py` finds the router and the cell, `cell.py` represents the cell, `poses.py` waits for poses, `publish.py` checks and
sends measurements, `aio.py` is all of it for `async` programs. The client needs none of the libraries of the services.
"""
