"""What comes of a run: renderings, their metrics, and the files that hold models, rows and pictures."""
