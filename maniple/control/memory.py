"""What layers remember, so that they go on after the process was started again."""

import math


def remembered(layer: object) -> tuple[float, ...]:
    """The state of a layer, see `parts.Remembering`; empty where it offers none.

    Raises:
        ValueError: it is not made of finite numbers.
    """
    memory = tuple(map(float, getattr(layer, "memory", ())))
    if not all(map(math.isfinite, memory)):
        raise ValueError(f"remembers {memory}; must be finite")
    return memory


def recall(layer: object, memory: tuple[float, ...]) -> None:
    """Let a layer go on from a state. One that can't begins anew.

    Raises:
        ValueError: it is no state of this layer.
    """
    if (take := getattr(layer, "recall", None)) is not None:
        take(memory)
