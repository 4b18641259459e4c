"""The one exception for a user's mistake."""


class UserError(Exception):
    """A mistake in what the user gave; the text is one line that names the culprit and says what would be right."""
