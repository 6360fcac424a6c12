"""How fast the parts are: each measured many times, and told as medians and quartiles."""
