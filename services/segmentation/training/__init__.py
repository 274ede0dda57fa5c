"""Makes the segmentation's weights again, and measures them."""
