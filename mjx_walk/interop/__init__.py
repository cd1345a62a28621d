"""The tasks and policies in formats of other software: Gymnasium and Brax environments, ONNX files, Minari's datasets.

Adapters that bring other software's tasks or trainers to us do not belong here; they are in `experiments`.
"""
