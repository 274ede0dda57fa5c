"""The simulated cell as a process, the only one that knows the truth.

In: control queries. Out: camera frames, joint angles, electrode voltages, and the truth. The world is `sim.world.world`.
"""
