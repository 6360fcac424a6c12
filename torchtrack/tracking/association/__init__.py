"""Which contour point each observation is of, and how far to trust that."""
