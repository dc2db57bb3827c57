"""A sweep's members have the bits of single runs, which are other programs."""

from collections.abc import Iterator

import pytest

import haste


@pytest.fixture(scope="module")
def quick_compilation_of_module() -> Iterator[None]:
    """In haste as all tests, but for the fusions."""
    with haste.fusions_of_a_user():
        yield
