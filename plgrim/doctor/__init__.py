"""`plgrim doctor`: findings about this machine and a running system, each with what mends it."""
