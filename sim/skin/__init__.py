"""What the simulated skin measures: fields, boards, and their faults."""
