"""The tasks and policies in formats of other software: Gymnasium environments, Brax environments and ONNX files.

Adapters that bring other software's tasks or trainers to us do not belong here; they are in `experiments`.
"""
