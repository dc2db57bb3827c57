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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from qrl.runs.record import RunConfig

PACKAGES = ("qrl", "qrl_envs")
LIBRARIES = ("jax", "jaxlib", "flax", "optax")
DEBUG = ("jax_debug_nans", "jax_debug_infs", "jax_disable_jit")
FORMAT = 1


class Store(NamedTuple):
    """A folder of traced programs, of one run's settings."""

    folder: Path
    of: str  # fingerprint of what else a program is made of

    @classmethod
    def of_run(cls, run: RunConfig) -> "Store | None":
        """That of a run's programs; None where they are not kept: of an environment whose source is not known here, of
        several processes, without a cache, or with settings of JAX that change how it traces.
        """
        settings = {name: str(getattr(jax.config, name, value)) for name, value in jax.config.values.items()}
        folder = jax.config.values["jax_compilation_cache_dir"]
        debugs = any(settings[name] == "True" for name in DEBUG)
        if not folder or run.task.spec is None or jax.process_count() > 1 or debugs:
            return None
        made_of = {
            "format": FORMAT,
            "sources": _sources(),
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

    def compile(self, args: tuple[Any, ...], options: dict[str, Any], donated: bool) -> Callable[..., Any]:
        """Compiled for arguments like `args`; with `donated` the first is given away."""
        first = len(jax.tree.leaves(args[0])) if donated else 0
        jitted = jax.jit(self.exported.call, donate_argnums=tuple(range(first)), compiler_options=options)
        compiled = jitted.lower(*jax.tree.leaves(args)).compile()
        return lambda *args: jax.tree.unflatten(self.structure, compiled(*jax.tree.leaves(args)))


def trace(store: Store, name: str, function: Callable[..., Any], args: tuple[Any, ...]) -> Program:
    """The program of function(*args), from the store or for it."""
    leaves, tree = jax.tree.flatten(args)
    like = [str(jax.typeof(x) if not isinstance(x, jax.ShapeDtypeStruct) else x) for x in leaves]
    key = hashlib.sha256("\n".join([store.of, name, str(tree), *like]).encode()).hexdigest()
    path = store.folder / f"qrl-{name}-{key}"
    if found := _read(path):
        return found
    structure: list[Any] = []

    def flat(*leaves: Any) -> list[Any]:
        result, of_result = jax.tree.flatten(function(*jax.tree.unflatten(tree, leaves)))
        structure.append(of_result)
        return result

    program = Program(export.export(jax.jit(flat))(*leaves), structure[-1])
    described = _described(jax.tree.unflatten(program.structure, range(program.structure.num_leaves)))
    if jax.tree.structure(_built(described)) == program.structure:
        content = json.dumps(described).encode() + b"\n" + program.exported.serialize()
        _write(path, hashlib.sha256(content).digest() + content)
    return program


def _write(path: Path, data: bytes) -> None:
    """Atomically; a full disk costs a command its time, not its run."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(path)


def _read(path: Path) -> Program | None:
    """What was kept at `path`; None if that is nothing, or not what was written."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    digest, content = data[:32], data[32:]
    if hashlib.sha256(content).digest() != digest:
        return None
    described, exported = content.split(b"\n", 1)
    return Program(export.deserialize(bytearray(exported)), jax.tree.structure(_built(json.loads(described))))


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


def _sources() -> str:
    """Fingerprint of the source and data files of qrl and its worlds."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        found = importlib.util.find_spec(package)
        for folder in (found.submodule_search_locations or []) if found else []:
            for path in sorted(Path(folder).rglob("*")):
                if path.suffix in (".py", ".json", ".csv"):
                    digest.update(f"{path.relative_to(folder)}\0".encode())
                    digest.update(path.read_bytes())
    return digest.hexdigest()
