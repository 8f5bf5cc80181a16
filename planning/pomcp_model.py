"""How the solver finds a model's compiled functions: statically, by the type of the model.

numba specialises the search on the model's NamedTuple type; each `model_...` call below is then the model's own
function, linked and inlined. (Functions handed over as arguments would be as fast, but numba never caches such code
on disk.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from planning.kernels import njit

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _overload(stub: Callable[..., Any]) -> Callable[[_Function], _Function]:
    """Not strict: numba's strict check compares annotations too, and a lambda has none."""
    decorate: Callable[[_Function], _Function] = overload(stub, strict=False)
    return decorate


class _ModelFunctions(NamedTuple):
    sample: Callable[..., None]
    step: Callable[..., tuple[int, float, float, bool]]
    actions: Callable[..., int]
    rollout: Callable[..., float]
    prior: Callable[..., None]


_FUNCTIONS: dict[type, _ModelFunctions] = {}


@njit
def no_prior(
    model: Any,
    state: NDArray[np.int64],
    actions: NDArray[np.int64],
    count: int,
    visits_out: NDArray[np.int64],
    values_out: NDArray[np.float64],
) -> None:
    """No virtual visits."""


def register_model(
    model_type: type,
    *,
    sample: Callable[..., None],
    step: Callable[..., tuple[int, float, float, bool]],
    actions: Callable[..., int],
    rollout: Callable[..., float],
    prior: Callable[..., None] = no_prior,
) -> None:
    """Tie the compiled functions (signatures in `planning.pomcp`) to a NamedTuple class, once, in the model's file.

    `TypeError` if the class is no NamedTuple or a function is not compiled; `ValueError` if it has its functions.
    """
    if not (issubclass(model_type, tuple) and hasattr(model_type, "_fields")):
        raise TypeError(f"a model must be a NamedTuple class, got {model_type!r}")
    functions = _ModelFunctions(sample, step, actions, rollout, prior)
    for name, function in functions._asdict().items():
        if not hasattr(function, "py_func"):
            raise TypeError(
                f"{name} of {model_type.__name__} is not compiled: decorate it with planning.kernels.njit"
            )
    if model_type in _FUNCTIONS:
        raise ValueError(f"{model_type.__name__} is registered already")
    _FUNCTIONS[model_type] = functions


def _functions_of(numba_type: Any) -> _ModelFunctions | None:
    return _FUNCTIONS.get(getattr(numba_type, "instance_class", None))  # type: ignore[arg-type]


def model_sample(model: Any, rng: Any, state: Any) -> None:
    """The model's `sample`."""
    raise NotImplementedError


def model_step(model: Any, state: Any, action: Any, rng: Any) -> Any:
    """The model's `step`."""
    raise NotImplementedError


def model_actions(model: Any, state: Any, actions_out: Any) -> Any:
    """The model's `actions`."""
    raise NotImplementedError


def model_rollout(model: Any, state: Any, depth_left: Any, rng: Any) -> Any:
    """The model's `rollout`."""
    raise NotImplementedError


def model_prior(model: Any, state: Any, actions: Any, count: Any, visits_out: Any, values_out: Any) -> None:
    """The model's `prior`."""
    raise NotImplementedError


@_overload(model_sample)
def _sample_of(model: Any, rng: Any, state: Any) -> Any:
    functions = _functions_of(model)
    if functions is None:
        return None
    sample = functions.sample
    return lambda model, rng, state: sample(model, rng, state)


@_overload(model_step)
def _step_of(model: Any, state: Any, action: Any, rng: Any) -> Any:
    functions = _functions_of(model)
    if functions is None:
        return None
    step = functions.step
    return lambda model, state, action, rng: step(model, state, action, rng)


@_overload(model_actions)
def _actions_of(model: Any, state: Any, actions_out: Any) -> Any:
    functions = _functions_of(model)
    if functions is None:
        return None
    actions = functions.actions
    return lambda model, state, actions_out: actions(model, state, actions_out)


@_overload(model_rollout)
def _rollout_of(model: Any, state: Any, depth_left: Any, rng: Any) -> Any:
    functions = _functions_of(model)
    if functions is None:
        return None
    rollout = functions.rollout
    return lambda model, state, depth_left, rng: rollout(model, state, depth_left, rng)


@_overload(model_prior)
def _prior_of(model: Any, state: Any, actions: Any, count: Any, visits_out: Any, values_out: Any) -> Any:
    functions = _functions_of(model)
    if functions is None:
        return None
    prior = functions.prior
    return lambda model, state, actions, count, visits_out, values_out: prior(
        model, state, actions, count, visits_out, values_out
    )
