"""Robots from model files: a floor and servos where a file lacks them, the standing pose, and the feet.

Pure functions of MuJoCo models and NumPy arrays belong here, and run once, when a task is made.
Observations, rewards and steps do not.
"""
