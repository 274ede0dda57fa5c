"""The simulated world: bodies, robot, skin, camera, occluders, motions, data sets. Only the emulator and train.py import it."""
