"""What a run says while it runs: metrics, log rows, their loggers, and progress.

Pictures are in `viewing`, and scores are in `storage`.
"""
