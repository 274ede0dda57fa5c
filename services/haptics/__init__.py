"""The skin's service: voltages of all pads (and the joint angles of the robot that carries them) come in, the target's pose
goes out, with an information matrix that is zero along what the skin does not feel.

Voltages are averaged over windows (`batches.py`); `pad_poses.py` says where the pads were. `estimator.py` finds the pose in each
window by least squares through the response law and the target's surface (`solve.py`). It follows one or two places (`track.py`)
and starts afresh from others (`starts.py`), such as the pose of the paper's network (`paper_network.py`), whose input are the
nearest surface points per pad (`paper_nearest.py`; paper, section "Haptic-based Pose Estimation"). Beside the pose it learns how
far each pad is to be believed (`trust.py`), the limb's size (`size.py`) and the electrodes' drift (`drift.py`). Its numbers are
in `settings.py`. `--method paper` is the network alone.

Beside the pose go out the nearest point of whatever is before each pad (`surface_points.py`), for which no shape is assumed, and
what touches pads or closes around a link (`contact.py`).
"""
