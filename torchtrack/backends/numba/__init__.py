"""The inner loops of the pipeline as Numba kernels, for the CPU: what takes PyTorch hundreds of small operations is one loop here.

A step of one object costs the calls of operations rather than what they compute, and one of many objects is bound by the memory
that each operation goes through. A kernel takes one object after the other, and holds what it needs of one observation in
registers. Every kernel computes what a function of the pipeline does, which its docstring names, and a test compares the two to
rounding. That function stays the reference: it is what runs on a GPU, where gradients are recorded, where Numba is not
installed, and under settings that the kernel does not know. :func:`torchtrack.core.dispatch.may_accelerate` decides.

Kernels know arrays and numbers, and nothing of the pipeline. They fill arrays that they are given, one row per object, and no
object's row depends on those of others, or on how many there are.
"""
