"""Benchmarks: suite/ compares trainers (`dsmoe bench`), timing/ times the rasterizer."""
