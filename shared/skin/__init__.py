"""The capacitive skin: its electrodes, their response to a limb, its boards and its faults."""
