"""What tests share: programs of one shape are compiled once in a session, machines to run kernels on, a tiny run."""

import gc
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is loaded; as the command line does

import jax
import pytest
from hypothesis import settings

import haste
import once
from cli_helpers import TINY, qrl
from cross_targets import need
from qrl.evaluation import calibration
from qrl.export import targets
from qrl.export.targets import Core

haste.compile_in_haste()
gc.set_threshold(50_000, 10, 10)  # what is traced allocates much and frees little: a tenth of its time

# Chosen by --hypothesis-profile. The default's cases are the same each time; those of `make stress` are drawn anew.
# The deadline of a case is for what hangs: the machine may be busy.
settings.register_profile("default", max_examples=100, deadline=10_000, derandomize=True, database=None)
settings.register_profile("stress", max_examples=10_000, deadline=10_000, database=None, print_blob=True)
settings.load_profile("default")


@pytest.fixture(scope="session", autouse=True)
def _compile_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """One for all workers of pytest-xdist. An entry read while another worker writes it fails to decompress, and JAX
    compiles instead.
    """
    folder = str(once.session_folder(tmp_path_factory) / "xla")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder  # for the command line, here or in a process of its own
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    jax.devices()  # one, whatever the first command here would say


THREADS = os.environ.get("PJRT_NPROC")


@pytest.fixture(autouse=True)
def _threads() -> Iterator[None]:
    """What a command in this process, or a fixture's, says to XLA is not for a test's processes."""

    def as_it_was() -> None:
        os.environ.pop("PJRT_NPROC", None)
        os.environ.update({} if THREADS is None else {"PJRT_NPROC": THREADS})

    as_it_was()
    yield
    as_it_was()


@pytest.fixture
def cross() -> None:
    """For a test that runs on targets of its own choice."""
    need([tool for toolchain in (targets.CORTEX_M, targets.RISC_V) for tool in targets.missing_tools(toolchain)])


@pytest.fixture
def host() -> None:
    need([] if targets.host_compiler() else ["a C compiler"])


@pytest.fixture
def core(request: pytest.FixtureRequest) -> Core | None:
    """The core of EACH or EITHER, where this machine can run it; None is the host."""
    request.getfixturevalue("cross" if request.param else "host")
    return request.param


def _trained(factory: pytest.TempPathFactory, task: str, *words: str) -> Path:
    """A copy, of this worker, of a run of 400 steps that the first of the workers trains."""

    def train(folder: Path) -> None:
        assert qrl("train", task, "--out", folder / "run", *words, *TINY.split()) == 0

    made = once.made_once(factory, f"trained {task}", train) / "run"
    return Path(shutil.copytree(made, factory.mktemp("runs") / task))


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a pendulum run of 400 steps. Add to it only what no other test would miss or find."""
    return _trained(tmp_path_factory, "pendulum")


@pytest.fixture(scope="session")
def trained_foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of Brax's own environment `fast`, which compiles at once; not to be changed."""
    return _trained(tmp_path_factory, "fast", "--episode-length", "20")


@pytest.fixture
def little_export(monkeypatch: pytest.MonkeyPatch) -> None:
    """For exports by command: few flights to calibrate on, and no emulated cores, which tests/export has."""
    monkeypatch.setattr(calibration, "STARTS", 10)
    monkeypatch.setattr(targets, "missing_tools", lambda _: ["the cross compiler"])
