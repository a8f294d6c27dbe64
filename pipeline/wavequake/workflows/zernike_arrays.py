"""Labelled arrays of Zernike coefficients, by other indices and over other annuli."""

from typing import TYPE_CHECKING

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.checks import array
from wavequake.optics.polynomials.indices import Scheme, convert_coefficients
from wavequake.optics.polynomials.transforms import known_transformed

if TYPE_CHECKING:
    import xarray as xr

_FIRST = {"noll": 1, "ansi": 0, "fringe": 1}


def convert_zernike(
    coefficients: "xr.DataArray",
    index: Scheme = "noll",
    *,
    source: float | None = None,
    target: float | None = None,
) -> "xr.DataArray":
    """Return the same wavefronts by another index of the polynomials, or over another annulus.

    Parameters
    ----------
    coefficients : xarray.DataArray
        With a dimension ``noll`` that counts 1, 2, ..., such as ``zernike`` of a store.
    index : {"noll", "ansi", "fringe"}
        ANSI/OSA counts from 0; Fringe polynomials have unit peak instead of unit rms.
    source : float, optional
        Obscuration (inner over outer radius) of the annulus that the given polynomials are orthogonal over;
        by default what the array says of itself.
    target : float, optional
        The same of the polynomials wanted (Störkle 2018, Eq. 3.53); by default 0 (circular ones) for Fringe,
        else `source`.

    Returns
    -------
    xarray.DataArray
        Its last dimension is called as `index`. A polynomial that the given ones do not hold is zero.

    Raises
    ------
    UserError
        If the dimension is missing or incomplete, the obscuration is not known or not in [0, 1), the index is
        unknown, or Fringe coefficients are wanted over an annulus.

    Examples
    --------
    >>> import xarray as xr
    >>> noll = xr.DataArray([0.0, 0.0, 0.0, 5.0], {"noll": [1, 2, 3, 4]}, "noll")
    >>> ansi = convert_zernike(noll, "ansi", source=0.0)
    >>> print(float(ansi.sel(ansi=4)))  # defocus
    5.0
    """
    import xarray as xr

    if not isinstance(index, str) or index not in _FIRST:
        raise UserError(f"The Zernike index {index!r} is unknown; choose one of {', '.join(_FIRST)}.")
    if not hasattr(coefficients, "dims"):
        kind = type(coefficients).__name__
        raise UserError(f"The coefficients are of the kind {kind}; give an xarray.DataArray over 'noll'.")
    if "noll" not in coefficients.dims:
        raise UserError(f"The array has no dimension 'noll', only {', '.join(map(str, coefficients.dims))}.")
    last = coefficients.transpose(..., "noll")
    count = last.sizes["noll"]
    if "noll" in last.coords and not np.array_equal(last["noll"].values, np.arange(1, count + 1)):
        raise UserError("The dimension 'noll' must count 1, 2, ... without a gap; convert before selecting.")
    given = last.attrs.get("obscuration") if source is None else source
    if given is None:
        raise UserError(
            "The array does not say over which annulus its polynomials are orthogonal; give source, the "
            "inner over the outer radius of the pupil (0 for a full one)."
        )
    inner = _ratio(given)
    wanted = (0.0 if index == "fringe" else inner) if target is None else _ratio(target)
    if index == "fringe" and wanted:
        raise UserError("Fringe polynomials are those of the full circle: leave out target, or give 0.")
    values = array(last.values, "The coefficients")
    if inner != wanted:
        values = known_transformed(values, inner, wanted)
    values = convert_coefficients(values, "noll", index)
    renamed = last.isel(noll=0, drop=True)
    labels = np.arange(values.shape[-1]) + _FIRST[index]
    return xr.DataArray(
        values,
        {**renamed.coords, index: (index, labels, {"long_name": f"{index} index of the polynomial"})},
        (*renamed.dims, index),
        name=last.name,
        attrs={**last.attrs, "obscuration": repr(wanted)},
    )


def _ratio(value: float | str) -> float:
    """Return an obscuration, which attributes of arrays hold as text."""
    try:
        ratio = float(value)
    except (TypeError, ValueError):
        ratio = np.nan
    if not 0.0 <= ratio < 1.0:
        raise UserError(f"The ratio of inner to outer pupil radius is {value!r}, it must lie in [0, 1).")
    return ratio
