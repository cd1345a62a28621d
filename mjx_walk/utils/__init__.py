"""Tools and types that every other room may use: settings, errors, signals, devices, processes, JAX's releases.

What knows a task, an algorithm, a run or training belongs in another room.
"""
