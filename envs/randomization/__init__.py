"""Randomized physics: the models, delays, noise and pushes that episodes draw.

Changes of a model, draws of an episode and their options belong here.
The steps of a changed model belong to `physics`, and what a task makes of them to the task.
"""
