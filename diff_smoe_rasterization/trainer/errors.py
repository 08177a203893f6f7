"""The errors a user can cause; the command prints their text and no traceback."""
from __future__ import annotations


class TrainerError(ValueError):
    """Something asked of the trainer cannot be done; the text says what and why."""


class SceneError(TrainerError):
    """A scene folder cannot be used; the text names the file and the reason."""


class ConfigError(TrainerError):
    """An option, or a file of options, has a value that it must not have."""
