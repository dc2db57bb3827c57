"""Peers' environments: one for each requirements file, made once, outside of git, and never shared with qrl's own."""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path


class NotInstalled(Exception):
    """Why a peer could not be installed, in a line."""


def python_of(requirements: Path, folder: Path) -> Path:
    """The interpreter of an environment that holds just what `requirements` pins; made in `folder` if need be.

    The stamp, which is the hash of what was asked for, is written last: an installation that was interrupted, or that
    was asked for with other pins, is made anew. NotInstalled, in a line, if it can't be.
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
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            said = [line for line in (done.stderr or done.stdout).splitlines() if "error" in line.lower()]
            raise NotInstalled((said or ["pip failed"])[-1].strip())
    stamp.write_text(wanted)
    return python


def fingerprint(requirements: Path) -> str:
    """Of a requirements file, of those that it names in turn, and of the Python that installs them."""
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
