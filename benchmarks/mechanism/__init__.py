"""What one recipe does to the Gaussians of each blend mode: record.py watches a training, plots.py draws it."""
