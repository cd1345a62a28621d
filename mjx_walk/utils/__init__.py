"""Tools and types that every other package may use: settings, errors, signals, devices, processes, JAX's releases.

Code that depends on tasks, algorithms, runs or training belongs in another package.
"""
