"""Grids of virtual runs: what to run, who runs it, and where the rows go."""
