"""The base of errors that a user can correct."""


class UserError(Exception):
    """An error that a user can correct; its message is one line without a secret."""
