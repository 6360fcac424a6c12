"""What everything stands on: SE(3), cameras, events, windows, values read back from a GPU, the seam to kernels."""
