"""The manifest of a checkpoint: the SHA-256 of every file, written last."""

import hashlib
import json
import os
from pathlib import Path

from qrl.runs.files import replace_text

MANIFEST = "manifest.json"
FORMAT = 4
_FORMER_MANIFEST = "seal.json"  # of formats 1 and 2


class CorruptCheckpoint(OSError):
    """A file of a checkpoint is not as it was written; the message names both."""


class IncompatibleCheckpoint(OSError):
    """A checkpoint of another run, or of another version of qrl."""


def write_manifest(path: Path) -> None:
    """Complete the checkpoint at `path`; every file is on disk before its manifest is."""
    digests = {name: _sha256(path / name) for name in _files(path)}
    for written in (path, *path.rglob("*")):  # Orbax leaves it to the system
        _sync(written)
    replace_text(path / MANIFEST, json.dumps({"format": FORMAT, "sha256": digests}) + "\n")


def has_manifest(path: Path) -> bool:
    """Whether the checkpoint at `path` was completed, by this version of qrl or another."""
    return (path / MANIFEST).exists() or (path / _FORMER_MANIFEST).exists()


def remove_manifest(path: Path) -> None:
    for name in (MANIFEST, _FORMER_MANIFEST):
        (path / name).unlink(missing_ok=True)


def verify(path: Path) -> None:
    """Raise CorruptCheckpoint if a file is missing or differs from its digest, IncompatibleCheckpoint if the format is
    not FORMAT, another OSError if a file cannot be read for now.
    """
    manifest = path / MANIFEST
    if not manifest.exists() and (path / _FORMER_MANIFEST).exists():
        raise IncompatibleCheckpoint(f"{path}: written by an earlier version of qrl, which this one cannot resume")
    try:
        data = json.loads(manifest.read_bytes())
    except (FileNotFoundError, IsADirectoryError, ValueError, RecursionError) as error:
        raise CorruptCheckpoint(f"{manifest}: cannot be read ({first_line(error)})") from None
    except OSError as error:
        raise OSError(f"{manifest}: cannot be read ({first_line(error)})") from None
    version, digests = (data.get("format"), data.get("sha256")) if isinstance(data, dict) else (None, None)
    if isinstance(version, int) and version != FORMAT:
        when = "a later" if version > FORMAT else "an earlier"
        raise IncompatibleCheckpoint(
            f"{path}: written by {when} version of qrl (format {str(version)[:20]}; this one reads {FORMAT})"
        )
    if version != FORMAT or not isinstance(digests, dict):
        raise CorruptCheckpoint(f"{manifest}: is corrupt")
    present = set(_files(path))
    for name, digest in digests.items():
        if name not in present:
            raise CorruptCheckpoint(f"{path}: {json.dumps(name)[:120]} is missing")
        try:
            actual = _sha256(path / name)
        except OSError as error:
            raise OSError(f"{path}/{name}: cannot be read ({first_line(error)})") from None
        if actual != digest:
            raise CorruptCheckpoint(f"{path}/{name}: is corrupt")


def first_line(error: Exception) -> str:
    text = (isinstance(error, OSError) and error.strerror) or str(error).strip()
    return text.split("\n")[0][:120]


def _files(path: Path) -> list[str]:
    def fail(error: OSError) -> None:  # os.walk would pass over a folder that cannot be read
        raise error

    inside = [Path(folder, name) for folder, _, names in os.walk(path, onerror=fail) for name in names]
    return sorted(str(file.relative_to(path)) for file in inside if file.is_file() and file.name != MANIFEST)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
