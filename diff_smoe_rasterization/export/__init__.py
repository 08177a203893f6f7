"""Trained models in forms that others show: `dsmoe export`. It uses the trainer's functions and the package's files."""
