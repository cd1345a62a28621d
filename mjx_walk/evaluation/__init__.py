"""Saved policies, and judgements outside training: scores in the real Gymnasium or a run's engine, parity of engines.

The evaluation that runs during training is in `common`, and comparisons of many runs are in `experiments`.
"""
