"""Finds the pose of the target in a camera's mask and image.

In: masks, frames, robot joints, and the fused pose as prediction. Out: the camera's pose with covariance, overlap, hidden share,
state.

`mask_fit.py` is a least-squares fit of the mesh's occluding contour (`contour.py`) to the mask's boundary that ignores hidden
parts (after SRT3D, Stoiber et al. 2022, doi:10.1007/s11263-022-01579-8, with mask boundaries in place of colour statistics).
`image_fit.py` refines its pose on the image, by the colours on both sides of the contour. `shape_fit.py` fits a limb that is not
quite the mesh. `paper_search.py` is the paper's gradient ascent on the overlap f_m. `evidence.py` classifies the pixels,
`detect.py` finds the target without a prediction, `starter.py` finds it from landmarks of hands and elbows, which `refinder.py`
looks for, `verdict.py` judges the pose, and `tracker.py` combines them. Its numbers are in `settings.py`. `objects/` does the
same for any rigid mesh and mask files (`search refine`, `search track`).

`penumbra bench search` (`bench objects` for `objects/`) shows what a change of a constant does.
"""
