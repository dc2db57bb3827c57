"""The hash of the code, which takes a quarter of a second, is computed once."""

from functools import cache

import pytest

from experiments.figures import runs

sha256 = cache(runs.sha256)


@pytest.fixture(autouse=True)
def _code_is_hashed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs, "sha256", sha256)
