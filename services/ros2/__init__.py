"""A participant of ROS 2 without ROS: what the cell knows goes out as ROS messages, joints and pictures of ROS come in.

Where ROS runs on Zenoh (`RMW_IMPLEMENTATION=rmw_zenoh_cpp`) its nodes meet at a Zenoh router. This process joins them as a client
that declares the keys and liveliness tokens which rmw_zenoh declares, and speaks CDR. Poses, twists, transforms, the overlaid
picture, the camera's model, markers and diagnostics are published; JointState and Image or CompressedImage become the joints and
frames of the cell. Source: the design and the sources of github.com/ros2/rmw_zenoh (docs/design.md, rmw_zenoh_cpp 0.2 to 0.14).
"""
