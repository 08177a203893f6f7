"""For `dsmoe run`, where simple_knn is not installed."""
