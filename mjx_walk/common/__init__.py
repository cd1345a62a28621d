"""Parts that several algorithms share: networks, losses, returns, replay, exploration, optimizers and rollouts.

What only one algorithm or one base class needs stands in `mjx_walk.algos`.
"""
