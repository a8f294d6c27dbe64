"""The plots of reports for one's own figures: each draws on matplotlib axes and returns them.

>>> import wavequake as wq
>>> axes = wq.plot.section("double-gauss")
>>> axes.get_xlabel()
'z (mm)'
"""

from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from wavequake.drawing.aperture import draw_aperture
from wavequake.drawing.draw import look, scene_of
from wavequake.drawing.layout import layouts
from wavequake.drawing.periodogram import has_spectrum
from wavequake.drawing.periodogram import spectrum as power_density
from wavequake.drawing.section import draw_section
from wavequake.drawing.still import draw_scene
from wavequake.drawing.style import COLORS, STYLE, Drawing
from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["aperture", "distribution", "history", "image", "section", "solid", "spectrum"]


def __dir__() -> list[str]:
    """Return what is offered, for the completion of names."""
    return __all__


def section(what: Any, axes: Axes | None = None, *, rays: int = 7) -> Axes:
    """Draw the section of a system with rays of all fields, to scale; arguments as `wavequake.draw`.

    Raises
    ------
    UserError
        If there is no such system.

    Examples
    --------
    >>> section("double-gauss", rays=3).get_ylabel()
    'y (mm)'
    """
    system = look(what).system
    if system is None:
        raise UserError(f"{_name(what)} has no optical system; wavequake.draw draws it.")
    axes = axes or _axes(9.0, 4.0)
    with rc_context(STYLE):
        draw_section(axes, layouts(system, rays)[0])
    return axes


def aperture(what: Any, axes: Axes | None = None) -> Axes:
    """Draw the primary mirror of a segmented telescope from above with the names of its segments.

    Raises
    ------
    UserError
        If there is no such telescope.

    Examples
    --------
    >>> aperture("tmt-18").get_ylabel()
    'y (m)'
    """
    telescope = look(what).telescope
    if telescope is None:
        raise UserError(f"{_name(what)} is no segmented telescope; wavequake.draw draws it.")
    axes = axes or _axes(7.0, 7.0)
    with rc_context(STYLE):
        draw_aperture(axes, telescope)
    return axes


def solid(what: Any, axes: Axes | None = None) -> Axes:
    """Draw a system, telescope or model in space; raises as `wavequake.draw`.

    Examples
    --------
    >>> len(solid("euv").collections) > 0
    True
    """
    axes = axes or _axes(9.0, 6.0)
    with rc_context(STYLE):
        draw_scene(axes, scene_of(look(what)))
    return axes


def image(values: "xr.DataArray", axes: Axes | None = None, *, decades: float = 4.0) -> Axes:
    """Show a point spread function or exposure (y, x) of a store on a logarithmic scale.

    Parameters
    ----------
    values : xarray.DataArray
        With the dims ``y`` and ``x`` alone, such as ``ds.exposure.sel(case=0)``.
    axes : matplotlib Axes, optional
    decades : float
        Below the largest value; what is darker looks alike.

    Raises
    ------
    UserError
        If there are other dims.

    Examples
    --------
    >>> import xarray as xr
    >>> pixels = {"y": [-1.0, 0.0, 1.0], "x": [-1.0, 0.0, 1.0]}
    >>> axes = image(xr.DataArray(np.eye(3) + 1e-3, pixels, ("y", "x"), "psf"))
    >>> axes.get_xlabel()
    'x'
    """
    if set(values.dims) != {"y", "x"}:
        raise UserError(f"An image has the dims y and x; choose one of {_others(values, {'x', 'y'})}.")
    axes = axes or _axes(5.5, 4.7)
    pixels = values.transpose("y", "x")
    x, y = (
        pixels[name].to_numpy() if name in pixels.coords else np.arange(pixels.sizes[name]) for name in "xy"
    )
    half_x, half_y = (0.5 * float(v[1] - v[0]) if len(v) > 1 else 0.5 for v in (x, y))
    shown = np.asarray(pixels.to_numpy(), dtype=np.float64)
    top = float(np.nanmax(shown))
    if not top > 0.0:
        raise UserError("The image is dark everywhere; there is nothing to show on a logarithmic scale.")
    with rc_context(STYLE):
        drawn = axes.imshow(
            np.maximum(shown, top * 10.0**-decades),
            norm=LogNorm(top * 10.0**-decades, top),
            origin="lower",
            extent=(x[0] - half_x, x[-1] + half_x, y[0] - half_y, y[-1] + half_y),
        )
        unit = str(values.attrs.get("units", ""))
        axes.figure.colorbar(
            drawn, ax=axes, label=f"irradiance ({unit})" if unit not in ("", "1") else "irradiance"
        )
        axes.set(xlabel=_label(values, "x"), ylabel=_label(values, "y"))
        words = str(values.attrs.get("long_name", values.name or ""))
        axes.set_title(fill(words, 50), loc="center")  # where a title of the user's replaces it
    return axes


def history(values: "xr.DataArray", axes: Axes | None = None, *, label: str | None = None) -> Axes:
    """Draw a variable of one case over time, a line per entry of its other dim.

    Parameters
    ----------
    values : xarray.DataArray
        With the dim ``time`` and at most one other, such as ``ds.los.sel(case=0)``.
    axes : matplotlib Axes, optional
    label : str, optional
        Of a single line.

    Raises
    ------
    UserError
        If there are other dims.

    Examples
    --------
    >>> import xarray as xr
    >>> time = {"time_s": ("time", [0.0, 0.1, 0.2])}
    >>> sight = xr.DataArray([0.0, 2.0, 1.0], time, "time", "los", {"units": "mas"})
    >>> history(sight).get_ylabel()
    'los (mas)'
    """
    others = [str(dim) for dim in values.dims if dim != "time"]
    if "time" not in values.dims or len(others) > 1:
        raise UserError(
            f"A history has the dim time and at most one other; choose one of {others or 'them'}."
        )
    axes = axes or _axes(7.0, 3.5)
    found = [name for name in ("time_s", "time") if name in values.coords and values[name].ndim == 1]
    time = values[found[0]].to_numpy() if found else np.arange(values.sizes["time"])
    lines = values.transpose("time", *others).to_numpy().reshape(len(time), -1)
    names = [str(name) for name in values[others[0]].to_numpy()] if others else [label]
    with rc_context(STYLE):
        for number, (line, name) in enumerate(zip(lines.T, names, strict=True)):
            axes.plot(time, line, color=COLORS[number % len(COLORS)], lw=1.0, label=name)
        axes.set(xlabel="time (s)" if found else "instant", ylabel=_label(values))
        if any(names):
            axes.legend()
    return axes


def spectrum(values: "xr.DataArray", axes: Axes | None = None) -> Axes:
    """Draw the amplitude spectral density of a variable of one case, a line per entry of its other dim.

    Parameters
    ----------
    values : xarray.DataArray
        With the dim ``time``, evenly spaced, and at most one other, such as ``ds.los.sel(case=0)``.
    axes : matplotlib Axes, optional

    Raises
    ------
    UserError
        If there are other dims, no times, fewer than 16 instants, or uneven ones.

    Examples
    --------
    >>> import xarray as xr
    >>> time = {"time_s": ("time", np.arange(64) * 0.01)}
    >>> swing = np.sin(2 * np.pi * 12.5 * time["time_s"][1])
    >>> axes = spectrum(xr.DataArray(swing, time, "time", "los", {"units": "mas"}))
    >>> hertz, density = axes.lines[0].get_data()
    >>> print(hertz[density.argmax()])
    12.5
    """
    others = [str(dim) for dim in values.dims if dim != "time"]
    time = next((values[name] for name in ("time_s", "time") if name in values.coords), None)
    if "time" not in values.dims or len(others) > 1 or time is None or time.ndim != 1:
        raise UserError("A spectrum is of one case over time, with at most one other dim.")
    seconds = np.asarray(time.to_numpy(), dtype=np.float64)
    there = np.isfinite(seconds)
    if not has_spectrum(seconds[there]):
        raise UserError("A spectrum needs at least 16 instants, evenly spaced.")
    axes = axes or _axes(7.0, 3.5)
    lines = values.transpose("time", *others).to_numpy().reshape(len(seconds), -1)[there]
    names = [str(name) for name in values[others[0]].to_numpy()] if others else [None]
    with rc_context(STYLE):
        for number, (line, name) in enumerate(zip(lines.T, names, strict=True)):
            hertz, density = power_density(seconds[there], line)
            axes.loglog(hertz, np.sqrt(density), color=COLORS[number % len(COLORS)], lw=1.0, label=name)
        unit = str(values.attrs.get("units", ""))
        axes.set(xlabel="frequency (Hz)", ylabel=f"{values.name or ''} ({unit} / √Hz)")
        if any(names):
            axes.legend()
    return axes


def distribution(
    values: "xr.DataArray",
    axes: Axes | None = None,
    *,
    by: str | None = None,
    side: Literal["below", "above"] = "below",
) -> Axes:
    """Draw which share of the cases lies below (or above) a value, a step line per population.

    Parameters
    ----------
    values : xarray.DataArray
        One number per case, or per case and instant: the rms over instants is taken.
    axes : matplotlib Axes, optional
    by : str, optional
        Coordinate of cases that tells populations apart; by default "disturbance" where there is one.
    side : {"below", "above"}

    Raises
    ------
    UserError
        If there are other dims.

    Examples
    --------
    >>> import xarray as xr
    >>> errors = xr.DataArray([3.0, 1.0, 2.0], dims="case", name="wfe", attrs={"units": "nm"})
    >>> distribution(errors).get_xlabel()
    'wfe (nm)'
    """
    if not {"case"} <= set(values.dims) <= {"case", "time"}:
        raise UserError(f"A distribution is over cases; choose one of {_others(values, {'case', 'time'})}.")
    numbers = (values**2).mean("time") ** 0.5 if "time" in values.dims else values
    label = by or ("disturbance" if "disturbance" in values.coords else None)
    populations = values[label].to_numpy() if label else np.full(numbers.sizes["case"], "")
    axes = axes or _axes(5.5, 4.0)
    cases = np.asarray(numbers.to_numpy(), dtype=np.float64)
    with rc_context(STYLE):
        for number, name in enumerate(dict.fromkeys(populations.tolist())):
            mine = np.sort(cases[(populations == name) & np.isfinite(cases)])
            share = np.arange(len(mine) + 1) / max(1, len(mine))
            share = share if side == "below" else 1.0 - share
            label_of, steps = f"{name} ({len(mine)})", np.append(mine[:1], mine)  # none is below the least
            color = COLORS[number % len(COLORS)]
            axes.step(steps, share[: len(steps)], where="post", color=color, label=label_of)
        axes.set(xlabel=_label(values), ylabel=f"share of cases {side}", ylim=(0.0, 1.0))
        if label:
            axes.legend(
                loc="upper left", bbox_to_anchor=(0.0, -0.16), ncols=3
            )  # steps may be anywhere inside
    return axes


def _axes(width: float, height: float) -> Axes:
    with rc_context(STYLE):
        return Drawing(figsize=(width, height), layout="constrained").add_subplot()


def _name(what: Any) -> str:
    return str(what) if isinstance(what, str | Path) else f"A {type(what).__name__}"


def _others(values: "xr.DataArray", known: set[str]) -> str:
    return ", ".join(str(dim) for dim in values.dims if dim not in known) or "another variable"


def _label(values: "xr.DataArray", coordinate: str | None = None) -> str:
    """Return a name with its unit."""
    of = values if coordinate is None else values[coordinate] if coordinate in values.coords else None
    name = coordinate or str(values.name or "")
    unit = "" if of is None else str(of.attrs.get("units", ""))
    return f"{name} ({unit})" if unit not in ("", "1") else name
