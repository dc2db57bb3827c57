"""Strict JSON specifications, with an error message of one line for every invalid file or flag.

The pydantic models of tasks and presets derive from `Spec`; `read` and `build` turn a file into one.
"""

import difflib
import json
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

LONGEST_MESSAGE = 900  # characters


class BadInput(ValueError):
    """Invalid user input. The message is one line: file or flag, key, and what was expected."""

    def __init__(self, message: str) -> None:
        # Keys and values may contain line breaks and terminal control codes, and be long.
        line = "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))
        super().__init__(line if len(line) <= LONGEST_MESSAGE else line[: LONGEST_MESSAGE - 1] + "…")


class Spec(BaseModel):
    """A frozen model of JSON: no unknown keys, no coercion between types, only finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def _as_int(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _fits_float32(value: float) -> float:
    if value and not 1e-30 <= abs(value) <= 1e30:
        raise ValueError(f"expected a magnitude that single precision holds (1e-30 to 1e30), found {value}")
    return value


Real = Annotated[float, AfterValidator(_fits_float32)]
Positive = Annotated[float, Field(gt=0), AfterValidator(_fits_float32)]
NonNegative = Annotated[float, Field(ge=0), AfterValidator(_fits_float32)]
Fraction = Annotated[float, Field(ge=0, le=1), AfterValidator(_fits_float32)]
Count = Annotated[int, BeforeValidator(_as_int), Field(ge=1, lt=2**31)]  # accepts 2e6
CountOrZero = Annotated[int, BeforeValidator(_as_int), Field(ge=0, lt=2**31)]

T = TypeVar("T")


def later(default: Any) -> Any:
    """A field that came after the first runs: where it says nothing new it is not written; so fingerprints stay."""
    return Field(default=default, exclude_if=lambda value: value == default)


def nearest(word: str, known: list[str]) -> str:
    """' (did you mean …?)' with the closest known word, or the list of all known words."""
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(sorted(known))})"


def read(path: Path) -> dict[str, Any]:
    """The JSON object in a file; raises BadInput if it is unreadable, not JSON, not an object, or repeats a key."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        data: dict[str, Any] = {}
        for key, value in pairs:
            if key in data:
                raise BadInput(f"{path}: key '{key}' stands twice")
            data[key] = value
        return data

    try:
        data = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=unique)
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None
    except json.JSONDecodeError as error:
        raise BadInput(f"{path}: line {error.lineno}, column {error.colno}: not JSON ({error.msg})") from None
    except BadInput:
        raise
    except (ValueError, RecursionError):  # not UTF-8, a number of thousands of digits, nested too deep
        raise BadInput(f"{path}: not JSON that can be read") from None
    if not isinstance(data, dict):
        raise BadInput(f"{path}: expected a JSON object, found {type(data).__name__}")
    return data


def _folder(name: str) -> Any:
    return resources.files("qrl_envs").joinpath(name)


def shipped(folder: str) -> list[str]:
    """Names of the files that ship in a folder of the package."""
    return sorted(
        entry.name.removesuffix(".json") for entry in _folder(folder).iterdir() if entry.name.endswith(".json")
    )


def named(what: str, folder: str, name_or_path: str) -> dict[str, Any]:
    """The contents of a file that ships in `folder`, or of a `.json`; BadInput with one line if there is none."""
    if name_or_path in shipped(folder):
        return read(Path(str(_folder(folder).joinpath(f"{name_or_path}.json"))))
    if not name_or_path.endswith(".json"):
        raise BadInput(f"unknown {what} '{name_or_path}'{nearest(name_or_path, shipped(folder))}")
    return read(Path(name_or_path))


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the keys of `over`: objects merge recursively, unless their "form" differs; other values replace."""
    merged = dict(base)
    for key, value in over.items():
        old = base.get(key)
        if isinstance(value, dict) and isinstance(old, dict) and value.get("form") in (None, old.get("form")):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged


def build(kind: type[T] | Any, data: dict[str, Any], where: str) -> T:
    """Validates `data` as the pydantic model or annotated union `kind`; BadInput names `where` and the key."""
    adapter: TypeAdapter[T] = TypeAdapter(kind)
    try:
        return adapter.validate_json(json.dumps(data))
    except ValidationError as error:
        raise BadInput(f"{where}: {_first_line(error, kind)}") from None


def _first_line(error: ValidationError, kind: Any) -> str:
    # A misspelled key also leaves the intended one missing; report the misspelling.
    problem = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    model, path = _follow(kind, problem["loc"])
    context = problem.get("ctx", {})
    if problem["type"] in ("union_tag_invalid", "union_tag_not_found"):
        key = ".".join([*path, context["discriminator"].strip("'")])
        expected = context.get("expected_tags") or ", ".join(map(repr, filter(None, map(_tag, _models(kind)))))
        return f"key '{key}': expected one of {expected}, found {json.dumps(context.get('tag'))}"
    key = ".".join(path)
    if problem["type"] == "extra_forbidden":
        return f"unknown key '{key}'{nearest(path[-1], _names(model)) if model else ''}"
    if problem["type"] == "missing":
        return f"key '{key}' is missing"
    if problem["type"] == "value_error":  # from our validators, whose messages are complete
        return f"key '{key}': {context['error']}" if key else str(context["error"])
    found = json.dumps(problem["input"], default=str)
    message = problem["msg"].replace("Input should be", "expected").replace("Input should have", "expected")
    message = message[0].lower() + message[1:]
    return f"{f'key {key!r}: ' if key else ''}{message}, found {found if len(found) < 60 else found[:57] + '...'}"


def _names(model: type[BaseModel]) -> list[str]:
    """A model's keys in a file."""
    return [field.alias or name for name, field in model.model_fields.items()]


def _models(kind: Any) -> list[type[BaseModel]]:
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return [kind]
    return [model for part in get_args(kind) for model in _models(part)]


def _follow(kind: Any, loc: tuple[int | str, ...]) -> tuple[type[BaseModel] | None, list[str]]:
    """The innermost model at a pydantic error's `loc`, and the key's path in the file, without union tags."""
    models, path, inner = _models(kind), [], None
    for part in loc:
        field = next((m for m in models if isinstance(part, str) and part in m.model_fields), None)
        tagged = [m for m in models if _tag(m) == part]
        if field is None and tagged and len(models) > 1:
            models = tagged
            continue
        inner = field or (models[0] if isinstance(part, str) and models else inner)
        path.append(str(part))
        models = _models(field.model_fields[str(part)].annotation) if field else models
    return inner, path


def _tag(model: type[BaseModel]) -> Any:
    return next((get_args(f.annotation)[0] for n, f in model.model_fields.items() if n in ("world", "form")), None)
