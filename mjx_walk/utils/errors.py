"""The one exception for what a user can put right."""


class UserError(ValueError):
    """A mistake in what the user asked for. Commands print its one line and exit with code 2, without a traceback."""
