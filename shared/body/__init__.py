"""The bodies in a cell: the person's meshes and the robot's links."""
