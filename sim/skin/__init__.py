"""The simulated skin: fields, boards, and their faults."""
