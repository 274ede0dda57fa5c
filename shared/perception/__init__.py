"""Code shared by the senses: image windows, the result of vision, landmarks, and joint angles at a stamp."""
