"""A live viewer of trained models and running trainings in the browser: `dsmoe view`, by viser."""
