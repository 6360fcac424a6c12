"""Learning with the tracker as a layer: datasets of windows with true poses, and how what the package ships was trained.

Gradients come from the tracker itself (:mod:`torchtrack.tracking.estimation.implicit_gradient`); nothing of it imports from here.
"""
