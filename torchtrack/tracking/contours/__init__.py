"""From a pose to the visible contours of an object."""
