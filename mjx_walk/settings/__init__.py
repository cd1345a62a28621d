"""Settings of a run: the schema, recipes, overrides, files that settings name, and the saved configuration.

Modules turn a command line into checked dataclasses and back. Parsing of other commands is in `cli`.
"""
