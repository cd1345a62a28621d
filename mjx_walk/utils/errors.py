"""The exception for errors that the user can correct."""


class UserError(ValueError):
    """Invalid input. Commands print its one-line message without a traceback and exit with code 2."""
