"""The simulated cell as a function of time: persons, robot, and how they move."""
