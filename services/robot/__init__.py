"""Publishes the joint angles of real robots: from controllers of Universal Robots (RTDE), of Franka (FCI), and from one's own
adapters. Joints are matched by their names, never by their order; stamps are the controller's, brought to this host's clock.
"""
