"""The capacitive skin: where its electrodes are, what they read near a limb, its boards and its faults."""
