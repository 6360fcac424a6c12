"""From matches to poses: the rounds of matching and solving, and the one solver."""
