"""Output of a run while it trains: metrics, log rows, their loggers, and progress.

Pictures are in `viewing`, and scores are in `storage`.
"""
