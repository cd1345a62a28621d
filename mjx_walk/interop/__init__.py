"""The tasks and policies in formats of other software: Gymnasium, Brax, gymnax, trainers in PyTorch, ONNX and Minari.

Adapters that bring other software's tasks or trainers to us do not belong here; they are in `experiments`.
"""
