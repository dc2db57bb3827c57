"""Virtual environments of the baselines, one for each requirements file, separate from qrl's own."""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path


class NotInstalled(Exception):
    """A baseline could not be installed; the message is one line."""


def python_of(requirements: Path, folder: Path, seconds: float | None = None) -> Path:
    """The interpreter of the environment in `folder` with what `requirements` pins, created if missing or stale.

    The stamp, a hash of the requirements, is written last, so that an interrupted installation is repeated. Raises
    NotInstalled, also where pip takes more than so many `seconds`.
    """
    python, stamp = folder / "bin" / "python", folder / "installed"
    wanted = fingerprint(requirements)
    if python.exists() and stamp.exists() and stamp.read_text() == wanted:
        return python
    shutil.rmtree(folder, ignore_errors=True)
    pip = [str(python), "-m", "pip", "--require-virtualenv", "--disable-pip-version-check", "-q"]
    for command in (
        [sys.executable, "-m", "venv", str(folder)],
        [*pip, "install", "-r", str(requirements)],
    ):
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
        except subprocess.TimeoutExpired:
            raise NotInstalled(f"pip took more than {seconds:.0f} s") from None
        if done.returncode:
            errors = [line for line in (done.stderr or done.stdout).splitlines() if "error" in line.lower()]
            raise NotInstalled((errors or ["pip failed"])[-1].strip())
    stamp.write_text(wanted)
    return python


def fingerprint(requirements: Path) -> str:
    """A hash of a requirements file, the files it includes, and the Python version."""
    digest = hashlib.sha256(sys.version.encode())
    for path in _with_included(requirements):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _with_included(path: Path) -> list[Path]:
    files = [path]
    for line in path.read_text().splitlines():
        if line.startswith(("-c ", "-r ")):
            files += _with_included(path.parent / line[3:].strip())
    return files
