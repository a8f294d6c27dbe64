"""How often kernels ran in this process, and how long by the device's own clock."""

from typing import Any

_LAUNCHES: dict[str, tuple[int, float]] = {}


def count_launch(name: str, event: Any) -> None:
    """Add a kernel that has ended, an event of a queue that keeps times."""
    import pyopencl as cl

    try:
        seconds = 1e-9 * (event.profile.end - event.profile.start)
    except cl.Error:  # a driver that keeps none
        return
    launches, before = _LAUNCHES.get(name, (0, 0.0))
    _LAUNCHES[name] = launches + 1, before + seconds


def kernel_launches() -> dict[str, tuple[int, float]]:
    """Return launches and seconds of every kernel by name, since the process began."""
    return dict(_LAUNCHES)


def launches_since(before: dict[str, tuple[int, float]]) -> dict[str, float]:
    """Return what came since `kernel_launches` gave `before`: "kernel NAME" in s, "launches NAME"."""
    timings: dict[str, float] = {}
    for name, (launches, seconds) in _LAUNCHES.items():
        earlier, spent = before.get(name, (0, 0.0))
        if launches > earlier:
            timings[f"kernel {name}"] = seconds - spent
            timings[f"launches {name}"] = launches - earlier
    return timings
