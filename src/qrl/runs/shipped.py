"""Trained runs that ship with the package: run folders with the learner of their last checkpoint."""

import hashlib
import shutil
import tempfile
from pathlib import Path

from qrl.runs.files import writing

SHIPPED = Path(__file__).parents[1] / "policies"
COPIES = Path("runs") / "shipped"


def names() -> list[str]:
    return sorted(path.parent.name for path in SHIPPED.glob("*/config.json"))


def run_folder(run: Path) -> Path:
    """`run`; or, where there is no such folder and it is the name of a shipped run, a copy of that in runs/shipped.

    For what is made of a run is written to its folder. The copy's name ends in a version: no other one replaces it.
    """
    if run.exists() or str(run) not in names():
        return run
    source = SHIPPED / run.name
    copy = COPIES / f"{run.name}-{_version(source)}"
    if copy.is_dir():
        return copy
    COPIES.mkdir(parents=True, exist_ok=True)
    with writing(copy), tempfile.TemporaryDirectory(dir=COPIES, prefix=".copy-") as work:
        made = shutil.copytree(source, Path(work) / run.name)
        try:
            made.rename(copy)
        except OSError:
            if not copy.is_dir():  # else another process was first
                raise
    return copy


def _version(folder: Path) -> str:
    """Eight digits that say which run it is: of the digest of its settings and its checkpoints' manifests."""
    files = sorted([folder / "config.json", *folder.glob("checkpoints/*/manifest.json")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:8]
