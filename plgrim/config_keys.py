"""Unknown keys: where they stand, and which key was probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from plgrim.errors import ConfigError


def nearest(name: str, known: list[str]) -> str:
    """A hint: the key that was probably meant, or the keys there are."""
    close = difflib.get_close_matches(name, known, 1, 0.5)
    if close:
        return f"did you mean {close[0]!r}?"
    return f"there are {', '.join(sorted(known))}" if known else "there are no keys here"


def check_keys(content: Any, model: type[BaseModel], source: str, path: str) -> None:
    """Refuse keys that the model, or a model inside it, does not have; ConfigError names source, path and a hint.

    Walks the models itself, so that a nested model which forgot to forbid unknown keys cannot let a typo pass.
    """
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        where = f"{path}.{key}" if path else str(key)
        field = model.model_fields.get(str(key))
        if field is None:
            raise ConfigError(
                f"{source}: unknown key {where!r}: {nearest(str(key), list(model.model_fields))}"
            )
        for inner in _models_in(field.annotation):
            for item in value if isinstance(value, list | tuple) else [value]:
                check_keys(item, inner, source, where)


def _models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        return
    found = [model for part in get_args(annotation) for model in _models_in(part)]
    if len(found) == 1:  # a union of several models is left to pydantic, which knows which one is meant
        yield found[0]


def check_env_name(variable: str, known: tuple[str, ...]) -> None:
    """Refuse a variable that looks like a misspelt key; other variables with the prefix are not ours to judge."""
    name = variable.removeprefix("PLGRIM_")
    close = difflib.get_close_matches(name, known, 1, 0.85)
    if close:
        raise ConfigError(f"environment: unknown variable {variable}: did you mean PLGRIM_{close[0]}?")


def describe(error: ValidationError, source: str, path: str = "") -> str:
    """One line a fault: source, path of the key, what is wrong and what was given."""
    lines = []
    for fault in error.errors():
        where = ".".join([path] * bool(path) + [str(part) for part in fault["loc"]])
        given = "" if isinstance(fault["input"], dict) else f" (given: {fault['input']!r})"
        lines.append(f"{source}: {where}: {fault['msg']}{given}")
    return "\n".join(lines)
