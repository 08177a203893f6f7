"""The options of a training: checks, presets and flags. None of these modules loads torch when it is imported.
Read config.py with importance_options.py, presets.py, config_arguments.py, early.py; then the three short files."""
