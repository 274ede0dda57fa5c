"""Makes PoseCNN's weights again, and measures them."""
