"""How often kernels ran in this process, how long by the device's own clock, and what was copied for them."""

from typing import Any, Literal

_COUNTED: dict[str, float] = {}


def count_launch(name: str, event: Any) -> None:
    """Add a kernel that has ended, an event of a queue that keeps times."""
    import pyopencl as cl

    try:
        seconds = 1e-9 * (event.profile.end - event.profile.start)
    except cl.Error:  # a driver that keeps none
        return
    _count(f"kernel {name}", seconds)
    _count(f"launches {name}", 1)


def count_bytes(way: Literal["to", "from"], size: int) -> None:
    """Add bytes that are copied to or from a device; one that works in the host's memory copies none."""
    _count(f"bytes {way} device", size)


def kernel_launches() -> dict[str, float]:
    """Return what was counted since the process began.

    That is "kernel NAME" in s, "launches NAME", "bytes to device" and "bytes from device".
    """
    return dict(_COUNTED)


def launches_since(before: dict[str, float]) -> dict[str, float]:
    """Return what came since `kernel_launches` gave `before`, by the same names."""
    return {
        name: count - before.get(name, 0.0) for name, count in _COUNTED.items() if count != before.get(name)
    }


def _count(name: str, more: float) -> None:
    _COUNTED[name] = _COUNTED.get(name, 0) + more
