"""PoseCNN, the paper's rival, in place of segmentation and search: camera frames and the fused pose (where to look) in, the
camera's pose of the target out.

Source: Y. Xiang, T. Schmidt, V. Narayanan, D. Fox: PoseCNN, RSS 2018, arXiv:1711.00199. What differs is said in `network.py`
and in the card of the weights.
"""
