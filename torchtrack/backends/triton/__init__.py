"""The rounds of matching and solving as Triton kernels, for a GPU: what takes PyTorch several hundred small kernels is three a round here.

Each computes what a function of the pipeline does, which its docstring names, and a test compares the two to rounding, in Triton's
interpreter where there is no GPU. That function stays the reference. No program decides anything that the pipeline decides once:
status, loss and trust of a track are torch's. No object's numbers depend on those of others, or on how many there are.
"""
