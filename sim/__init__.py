"""The simulated world: bodies, robot, skin, camera, occluders, motions and data sets. Only the emulator and train.py import it."""
