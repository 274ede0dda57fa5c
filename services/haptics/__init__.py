"""The skin's share: voltages of all pads (and the joint angles of the robot that carries them) come in, the target's pose
goes out, with an information matrix that is zero along what the skin does not feel.

Voltages are averaged over windows (`window.py`). `estimator.py` finds the pose in each by least squares through the response
law and the target's surface (`solve.py`), started by the paper's network (`network.py`), whose input are the nearest
surface points per pad (`nearest.py`; paper, section "Haptic-based Pose Estimation"). `--method paper` is the network alone.
"""
