"""A printed ChArUco board measures the lens of a camera, and with a robot that carries it where the camera stands. Both
go into the cell file.

Intrinsics: Zhang, "A flexible new technique for camera calibration" (2000), doi:10.1109/34.888718, as OpenCV has it. Camera to
robot: Shah, "Solving the Robot-World/Hand-Eye Calibration Problem Using the Kronecker Product" (2013), doi:10.1115/1.4024473, and
from there least squares on the corners in the pictures.
"""
