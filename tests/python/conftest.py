"""Fixtures of all tests: the four blend modes, and an environment that selects none of them."""
from __future__ import annotations

import pytest


@pytest.fixture(params=["alpha", "smoe", "smoe_tn", "smoe_std"])
def mode(request):
    return request.param


@pytest.fixture(autouse=True)
def no_blend_mode_in_the_environment(monkeypatch):
    monkeypatch.delenv("DSMOE_BLEND_MODE", raising=False)
