"""The terminal: arguments, messages, exit codes, and the streams they are written to.

The settings of a training are in `settings`, because Hydra parses them.
"""
