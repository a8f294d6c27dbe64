"""What loops leave is told as far as their linear light is known."""

import numpy as np
import pytest
import xarray as xr

from wavequake.report.loops.telescope import results


def test_what_is_left_below_the_error_of_linear_light_is_nothing():
    left = xr.DataArray([[[3.0, 4.0], [2e-7, 2e-7]]], dims=("case", "controller", "time"))
    cases = xr.Dataset(
        {
            "wfe_rms": left,
            "los": left / 10,
            "light_error_wfe_rms": (("case", "controller"), [[1e-6, 1e-7]]),
            "light_error_los": (("case", "controller"), [[1e-6, 1e-6]]),
        },
        {"controller": ["off", "perfect"]},
    )
    off, perfect = results(cases)
    assert (off.wfe, off.los) == pytest.approx((12.5**0.5, 0.125**0.5))
    assert perfect.wfe == pytest.approx(2e-7)  # larger than its error: it stays
    assert perfect.los == 0.0
    unknown = results(cases.assign(light_error_los=np.nan * cases.light_error_los))[1]
    assert unknown.los == pytest.approx(2e-8)


def test_what_is_off_by_much_is_not_the_best():
    """3 nm that are off by 3.2 are not nothing: another controller leaves 2."""
    cases = xr.Dataset(
        {
            "wfe_rms": (("case", "controller", "time"), [[[9.0], [3.0], [2.0]]]),
            "los": (("case", "controller", "time"), [[[9.0], [3.0], [2.0]]]),
            "light_error_wfe_rms": (("case", "controller"), [[0.1, 3.2, 1.0]]),
            "light_error_los": (("case", "controller"), [[0.1, 3.2, 1.0]]),
        },
        {"controller": ["off", "a", "b"]},
    )
    assert [one.wfe for one in results(cases)] == [9.0, 3.0, 2.0]
    assert [one.los for one in results(cases)] == [9.0, 3.0, 2.0]
