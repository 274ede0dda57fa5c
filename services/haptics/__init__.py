"""The skin's service: voltages of all pads (and the joint angles of the robot that carries them) come in, the target's pose
goes out, with an information matrix that is zero along what the skin does not feel.

Voltages are averaged over windows (`batches.py`); `pad_poses.py` gives the pads' poses. `estimator.py` finds the limb's pose in
each window by least squares through the response law and the target's surface (`solve.py`). It tracks one or two places
(`track.py`) and restarts from others (`starts.py`), such as the pose of the paper's network (`paper_network.py`), whose inputs
are the nearest surface points per pad (`paper_nearest.py`; paper, section "Haptic-based Pose Estimation"). It also learns the
trust in each pad (`trust.py`), the limb's size (`size.py`) and the electrodes' drift (`drift.py`). Its numbers are in
`settings.py`. `--method paper` is the network alone.

The service also publishes the nearest surface point before each pad (`surface_points.py`), which assumes no shape, and contact:
touched pads, and grips around a link (`contact.py`).
"""
