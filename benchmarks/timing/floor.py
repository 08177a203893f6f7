"""The arithmetic floor of the blend: the pairs it walks, the vector instructions of each, and the machine's rate.

floor = walked pairs x instructions per pair / (lanes x issue rate x clock)

- Walked pairs are the (Gaussian, pixel) pairs whose exponent the kernels evaluated, whole SIMD registers counted.
- Instructions per pair are the floating-point operations, comparisons and selections of the formulas in gate.h and
  blend.h for three colour channels, a multiply-add counted once. Loads, stores, mask logic, what a Gaussian, a row or
  a column needs once, and the reduction over lanes count nothing. That most registers of a footprint's edge are left
  after the exponent is ignored too: every walked pair counts in full. Pairs of smooth cells need fewer
  (tile_walk_impl.h).
- The denominator is measured as one number: the multiply-adds a second of torch's matrix product. A core that adds
  and compares beside its multiply-add units can stay below this floor.
"""
from __future__ import annotations

import time

import torch

_EXPONENT = 2  # quadratic in dy: two multiply-adds
_EXPONENTIAL = 14  # clamp; n: multiply-add, subtract; remainder: 2; polynomial: 6; 2^n: shift, add, multiply
_LOGIT = 2  # o G; min with 0.99
# power <= 0; alpha >= 1/255 or 1/2040, or G and alpha_min
_TESTS = {"alpha": 2, "smoe": 2, "smoe_eq7": 3, "smoe_tn": 3, "smoe_std": 3}
_GATE = {mode: _EXPONENT + _EXPONENTIAL + _LOGIT + tests for mode, tests in _TESTS.items()}
_FEATURES = 3  # a multiply-add a channel

_TRANSMIT = 7  # 1 - alpha; T (1 - alpha); open?; full?; weight; T of pairs that contribute, and of those that close
_SUMS = 1 + _FEATURES + 1  # gate sum; colour; last contributor
FORWARD = {mode: gate + _SUMS + (0 if mode == "smoe_std" else _TRANSMIT) for mode, gate in _GATE.items()}

_RECIPROCAL = 3  # estimate and one Newton step, the cheapest that float accuracy allows
# 1 - alpha; reciprocal; T; weight; T u - R / (1 - alpha); suffix; and u
_TRANSMIT_BACKWARD = 1 + _RECIPROCAL + 6
_VALUE = 1 + _FEATURES  # within the list's seen part?; g'.c
_MOMENTS = 1 + 3  # dL/dpower; sums of it times 1, dy, dy^2
_BACKWARD_REST = _VALUE + _FEATURES + _MOMENTS
BACKWARD = {mode: gate + _BACKWARD_REST + (1 if mode == "smoe_std" else _TRANSMIT_BACKWARD)
            for mode, gate in _GATE.items()}  # smoe_std: only u


def multiply_adds_per_second(threads: int, size: int = 1024, repeats: int = 12) -> float:
    """Returns the float32 multiply-adds a second that torch's matrix product reaches, the best of some repeats."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        a, b = torch.rand(size, size), torch.rand(size, size)
        out = a @ b
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            torch.mm(a, b, out=out)
            seconds.append(time.perf_counter() - start)
    finally:
        torch.set_num_threads(before)
    return size**3 / min(seconds)


def floor_seconds(mode: str, forward_pairs: float, backward_pairs: float, rate: float) -> float:
    """Returns the seconds that the walked pairs' instructions take at `rate` lanes a second."""
    return (forward_pairs * FORWARD[mode] + backward_pairs * BACKWARD[mode]) / rate
