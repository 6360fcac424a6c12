"""What runs in the place of the reference, operation by operation."""
