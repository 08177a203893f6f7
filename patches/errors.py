"""The one exception that users see."""


class PatchError(RuntimeError):
    """A refusal in plain words: it names the file and the rule, and nothing was written."""
