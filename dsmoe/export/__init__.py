"""Trained models in forms that others show: `dsmoe export`. It uses the trainer and the rasterizer's files."""
