"""Segmentation: frames come in, a class for every pixel of a window around the predicted target goes out; where the network has
priors, silhouettes of robots and targets, from joints and the fused pose, come in beside the frames.

The method is PredNet (Lotter, Kreiman, Cox 2017, arXiv:1605.08104) with hGRU cells (Linsley et al. 2018, arXiv:1805.08315),
as the paper's section on the visual modality has it: a stack of layers, each predicting what the layer below will send it.
"""
