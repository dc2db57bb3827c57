"""How tests compile: most of their time is XLA's, and what it compiles runs for milliseconds.

So it compiles in haste, here and in the processes that tests start, and all alike, so that what is compiled is shared.
`make smoke` compiles as a user's command does; under QRL_STRESS the fusions of tests are a user's, too.
"""

import contextlib
import os
from collections.abc import Iterator

import jax
import pytest

from qrl.training import trainer

FUSIONS = "--xla_cpu_use_fusion_emitters"
HASTY = f"{FUSIONS}=false"  # compiles in half the time


def compile_in_haste() -> None:
    """To be called before JAX initializes its devices."""
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
    jax.config.update("jax_disable_most_optimizations", True)
    flags = os.environ.get("XLA_FLAGS", "")
    if os.environ.get("QRL_STRESS") != "1" and FUSIONS not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {HASTY}".strip()


@contextlib.contextmanager
def fusions_of_a_user() -> Iterator[None]:
    """For programs that differ and are to have the same bits: with the hasty fusions each rounds otherwise. It holds
    for the programs of trainers that are made within, and for processes.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "xla_effort", lambda *_: {FUSIONS.removeprefix("--"): True})
        patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "").replace(HASTY, "").strip())
        yield
