"""Finds the pose of the target in the segmentation mask of a camera.

In: masks, robot joints, and the fused pose as prediction. Out: the camera's pose with covariance, overlap, hidden share, state.
`contour.py` is the default, a least-squares fit of the mesh's occluding contour to the mask's boundary that ignores what is
hidden (after SRT3D, Stoiber et al. 2022, doi:10.1007/s11263-022-01579-8, with mask boundaries in place of colour statistics);
`overlap.py` is the paper's gradient ascent on the overlap f_m. `evidence.py` says what each pixel tells about the target,
`detect.py` finds the target without a prediction, and `search.py` puts them together.
"""
