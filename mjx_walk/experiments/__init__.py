"""Experiments of many runs and measurements of speed: what the commands `compare`, `tune` and `bench` do.

The training of a single run is in `training`, and the drawing of its curves is in `viewing`.
"""
