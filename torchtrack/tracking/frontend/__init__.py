"""Events of a window as each object sees them, and the features of the paper: time surface, corners, flow."""
