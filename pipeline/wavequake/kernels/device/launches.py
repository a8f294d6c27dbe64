"""How often kernels ran in this process, how long by the device's own clock, and what was copied for them."""

from typing import Any, Literal

_LAUNCHES: dict[str, tuple[int, float]] = {}
_COPIED: dict[str, int] = {}


def count_launch(name: str, event: Any) -> None:
    """Add a kernel that has ended, an event of a queue that keeps times."""
    import pyopencl as cl

    try:
        start, end = map(event.get_profiling_info, (cl.profiling_info.START, cl.profiling_info.END))
    except cl.Error:  # a driver that keeps none
        return
    launches, before = _LAUNCHES.get(name, (0, 0.0))
    _LAUNCHES[name] = launches + 1, before + 1e-9 * (end - start)


def device_seconds() -> float:
    """Return how long all kernels have run so far."""
    return sum(seconds for _, seconds in _LAUNCHES.values())


def count_bytes(way: Literal["to", "from"], size: int) -> None:
    """Add bytes that are copied to or from a device; one that works in the host's memory copies none."""
    name = f"bytes {way} device"
    _COPIED[name] = _COPIED.get(name, 0) + size


def kernel_launches() -> dict[str, float]:
    """Return what was counted since the process began.

    That is "kernel NAME" in s, "launches NAME", "bytes to device" and "bytes from device".
    """
    counted: dict[str, float] = dict(_COPIED)
    for name, (launches, seconds) in _LAUNCHES.items():
        counted |= {f"kernel {name}": seconds, f"launches {name}": launches}
    return counted


def launches_since(before: dict[str, float]) -> dict[str, float]:
    """Return what came since `kernel_launches` gave `before`, by the same names."""
    now = kernel_launches()
    return {name: count - before.get(name, 0) for name, count in now.items() if count != before.get(name)}
