"""What a run is on disk: its configuration, folder, checkpoints, metrics, loggers and saved policy.

The training loop, algorithms and commands do not belong here.
"""
