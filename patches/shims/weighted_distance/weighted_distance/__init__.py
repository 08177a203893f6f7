"""For `dsmoe run`, where weighted_distance is not installed."""
