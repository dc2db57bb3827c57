"""Programs that are traced once on a machine.

Tracing costs a command seconds of Python; XLA's cache keeps only what compiling makes of the result. So that result,
StableHLO, is kept beside it, under a name that says what it was traced from.
"""

import dataclasses
import hashlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from qrl.runs.record import RunConfig

PACKAGES = ("qrl", "qrl_envs")
LIBRARIES = ("jax", "jaxlib", "flax", "optax", "chex", "numpy", "pydantic")
DEBUG = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit")
FORMAT = 1


class Store(NamedTuple):
    """A folder of traced programs, of one run's settings."""

    folder: Path
    of: str  # fingerprint of what else a program is made of

    @classmethod
    def of_run(cls, run: RunConfig, since: float) -> "Store | None":
        """That of a run's programs, in a process that began at `since` [s since the epoch]; None where none is kept.

        That is: of an environment whose source is not known here, or was edited since, so that it may not be what this
        process has read; of several processes; without a cache on disk; with settings of JAX that change how it traces.
        """
        settings = {name: str(getattr(jax.config, name, value)) for name, value in jax.config.values.items()}
        folder = jax.config.values["jax_compilation_cache_dir"]
        off = settings["jax_enable_compilation_cache"] != "True" or any(settings[name] == "True" for name in DEBUG)
        if off or not folder or "://" in folder or run.task.spec is None or jax.process_count() > 1:
            return None
        sources = Sources.read()
        if sources.edited > since:
            return None
        made_of = {
            "format": FORMAT,
            "sources": sources.digest,
            "python": sys.version,
            "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
            "jax": {name: value for name, value in settings.items() if not name.endswith("_dir")},
            "flags": os.environ.get("XLA_FLAGS", ""),
            "devices": [f"{device.platform} {device.device_kind}" for device in jax.devices()],
            "run": run.model_dump(mode="json", include={"task", "learner", "seeds"}),
        }
        return cls(Path(folder), hashlib.sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest())


class Program(NamedTuple):
    """A traced program of arguments that are pytrees."""

    exported: export.Exported
    structure: Any  # of its result

    @property
    def result(self) -> Any:
        """Shapes and types of its result."""
        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in self.exported.out_avals]
        return jax.tree.unflatten(self.structure, like)

    def lower(
        self, args: tuple[Any, ...], options: dict[str, Any], donated: int | None = None
    ) -> Callable[[], Callable[..., Any]]:
        """What compiles it for arguments like `args`; the one at `donated` may be overwritten."""
        sizes = [len(jax.tree.leaves(x)) for x in args]
        first = sum(sizes[:donated])
        given = () if donated is None else tuple(range(first, first + sizes[donated]))
        jitted = jax.jit(self.exported.call, donate_argnums=given, compiler_options=options)
        lowered = jitted.lower(*jax.tree.leaves(args))

        def compiled() -> Callable[..., Any]:
            program = lowered.compile()
            return lambda *args: jax.tree.unflatten(self.structure, program(*jax.tree.leaves(args)))

        return compiled


def find(store: Store, name: str, args: tuple[Any, ...]) -> Program | None:
    """The program of this name for arguments like these, where the store has it."""
    return _read(_path(store, name, args))


def _path(store: Store, name: str, args: tuple[Any, ...]) -> Path:
    leaves, tree = jax.tree.flatten(args)
    like = [str(x if isinstance(x, jax.ShapeDtypeStruct) else jax.typeof(x)) for x in leaves]
    key = hashlib.sha256("\n".join([store.of, name, str(tree), *like]).encode()).hexdigest()
    return store.folder / f"qrl-{name}-{key}"


def trace(store: Store, name: str, function: Callable[..., Any], args: tuple[Any, ...]) -> Program | None:
    """The program of function(*args), from the store or for it; None if it cannot be kept, as with a callback in it."""
    if found := find(store, name, args):
        return found
    leaves, tree = jax.tree.flatten(args)
    structure: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        result, of_result = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
        structure.append(of_result)
        return result

    try:
        program = Program(export.export(jax.jit(flat))(*leaves), structure[-1])
        described = _described(jax.tree.unflatten(program.structure, range(program.structure.num_leaves)))
        if jax.tree.structure(_built(described)) != program.structure:
            return None
        content = json.dumps(described).encode() + b"\n" + program.exported.serialize()
    except Exception:  # whatever JAX says of what it cannot write down, the program itself may well run
        return None
    _write(_path(store, name, args), hashlib.sha256(content).digest() + content)
    return program


def _write(path: Path, data: bytes) -> None:
    """Atomically; a full disk costs a command its time, not its run."""
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix="qrl-", suffix=".tmp", delete=False) as file:
            file.write(data)
        Path(file.name).replace(path)


def _read(path: Path) -> Program | None:
    """What was kept at `path`; None if that is nothing, or cannot be read."""
    try:
        data = path.read_bytes()
        digest, content = data[:32], data[32:]
        if hashlib.sha256(content).digest() != digest:
            return None
        described, exported = content.split(b"\n", 1)
        return Program(export.deserialize(bytearray(exported)), jax.tree.structure(_built(json.loads(described))))
    except Exception:  # of another version of JAX, say
        return None


def _described(tree: Any) -> Any:
    """A pytree's structure as JSON: of dicts, lists, tuples, named tuples and data classes, whose types are named."""
    parts: Any
    if isinstance(tree, dict):
        return {"dict": {key: _described(x) for key, x in tree.items()}}
    fields: Any = getattr(tree, "_fields", None)
    if fields is not None or dataclasses.is_dataclass(tree):
        names = [field.name for field in dataclasses.fields(tree)] if fields is None else fields
        parts = {name: _described(getattr(tree, name)) for name in names}
        return {"type": [type(tree).__module__, type(tree).__qualname__], "parts": parts}
    if isinstance(tree, list | tuple):
        return {type(tree).__name__: [_described(x) for x in tree]}
    return None if tree is None else 0


def _built(described: Any) -> Any:
    """A pytree of that structure, with leaves 0."""
    if not isinstance(described, dict):
        return described
    if "type" in described:
        module, name = described["type"]
        kind = getattr(importlib.import_module(module), name)
        return kind(**{key: _built(x) for key, x in described["parts"].items()})
    if "dict" in described:
        return {key: _built(x) for key, x in described["dict"].items()}
    (kind, parts), *_ = described.items()
    return {"list": list, "tuple": tuple}[kind](map(_built, parts))


class Sources(NamedTuple):
    """The source and data files of qrl and its worlds."""

    digest: str
    edited: float  # when the last of them was, in seconds since the epoch

    @classmethod
    def read(cls) -> "Sources":
        digest, edited = hashlib.sha256(), 0.0
        for package in PACKAGES:
            found = importlib.util.find_spec(package)
            for folder in (found.submodule_search_locations or []) if found else []:
                for path in sorted(Path(folder).rglob("*")):
                    if path.suffix in (".py", ".json", ".csv"):
                        digest.update(f"{path.relative_to(folder)}\0".encode())
                        digest.update(path.read_bytes())
                        edited = max(edited, path.stat().st_mtime)
        return cls(digest.hexdigest(), edited)
