"""What the senses share: where to look, what vision reports, and where things were at a stamp."""
