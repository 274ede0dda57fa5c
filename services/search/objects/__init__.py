"""`penumbra search refine` and `track`: the pose of any rigid mesh on files of masks and images."""
