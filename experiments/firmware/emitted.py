"""What `qrl export` writes for a firmware, written anew to a folder: the adapter's text as it is now."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from qrl.export import emit, vectors
from qrl.export.kernel import Kernel
from qrl.export.policy import Policy


class Adapter(Protocol):
    """A module of qrl.export.firmware."""

    @property
    def FOLDER(self) -> str: ...

    def files(self, policy: Policy, kernel: dict[str, str], name: str) -> Mapping[str, str | bytes]: ...


def emitted(adapter: Adapter, policy: Policy, kernel: Kernel, folder: Path, name: str) -> Path:
    """Write the kernel and the adapter to `folder`; the adapter's own folder in it."""
    files = emit.files(policy, kernel, vectors.golden(policy, kernel), name)
    for path, contents in {**files, **adapter.files(policy, files, name)}.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(contents.encode() if isinstance(contents, str) else contents)
    return folder / adapter.FOLDER
