"""Benchmarks: suite/ compares trainers (`dsmoe bench`), mechanism/ watches one, timing/ times the rasterizer."""
