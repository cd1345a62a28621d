"""A run on disk: the run folder, checkpoints, scores, and files that are written completely or not at all.

Nothing here knows tasks, algorithms or settings. The saved configuration is in `settings`.
"""
