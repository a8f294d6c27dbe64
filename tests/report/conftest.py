"""A small campaign with known answers: finished, failed and open cases, and an empty population."""

import json

import numpy as np
import pytest
import xarray as xr

from wavequake.report.segments.detail import Detail

TODO, DONE, RAISED, TIMED_OUT = 0, 1, 2, 4
HOSTILE = '</title><script>alert("x")</script><img src=x onerror=alert(1)> $\\frac{'


@pytest.fixture(scope="session")
def hexagons():
    """Seven hexagons with a side of 1000 mm around the origin, and six corners each, counter-clockwise."""
    pitch = 1000.0 * np.sqrt(3.0)
    azimuth = np.radians(60.0 * np.arange(6) + 30.0)
    centers = np.vstack([[0.0, 0.0], pitch * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)])
    around = np.radians(60.0 * np.arange(6))
    corners = centers[:, None] + 990.0 * np.stack([np.cos(around), np.sin(around)], axis=1)
    return centers, corners


@pytest.fixture(scope="session")
def detail(hexagons):
    """Case 3 of "wind": at instant i segment k is displaced by 10 i k nm; six rays around each center."""
    centers, corners = hexagons
    around = np.radians(60.0 * np.arange(6) + 30.0)
    rays = (centers[:, None] + 500.0 * np.stack([np.cos(around), np.sin(around)], axis=1)).reshape(-1, 2)
    segment = np.repeat(np.arange(7), 6)
    motion = np.zeros((3, 7, 6))
    motion[:, :, 2] = 10e-9 * np.arange(3)[:, None] * np.arange(7)
    axis = 0.25 * (np.arange(16) - 8)
    return Detail(
        case=3,
        disturbance="wind",
        segment_names=tuple(f"S{k}" for k in range(7)),
        corners=corners,
        centers=centers,
        time_s=np.array([0.0, 0.1, 0.2]),
        segment_motion=motion,
        ray_x=rays[:, 0],
        ray_y=rays[:, 1],
        ray_segment=segment,
        opd=-2e9 * motion[:, segment, 2],
        spot=np.arange(3.0)[:, None, None] * rays,
        airy_mas=5.0,
        image=np.exp(-np.hypot(*np.meshgrid(axis, axis))),
        image_x=axis,
        image_y=axis,
    )


@pytest.fixture
def campaign(pristine):
    """Give a copy of the campaign that a test may change."""
    return pristine.copy(deep=True)


@pytest.fixture(scope="session")
def pristine():
    """Cases 0..7 alternate between "wind" (4 instants) and "shake" (2, then NaN); 8 and 9 are "empty".

    Finished: wind 0, 2, 4 with WFE 10, 20, 30 nm at each instant, and 6 quarantined; shake 1, 3 with line of
    sight +-3 mas in x and +-4 mas in y, 5 timed out, 7 to do; both cases of "empty" are to do.
    """
    cases, instants = 10, 4
    disturbance = np.array(["wind", "shake"] * 4 + ["empty"] * 2, dtype=object)
    status = np.array([DONE, DONE, DONE, DONE, DONE, TIMED_OUT, RAISED, TODO, TODO, TODO], dtype=np.int8)
    message = np.array([""] * cases, dtype=object)
    message[[5, 6]] = "no answer after 600 s", "segment S1 lost all its rays"
    time = np.tile(np.arange(instants) * 0.1, (cases, 1))
    wfe = np.tile(10.0 * (np.arange(cases) // 2 + 1.0)[:, None], (1, instants))
    los = np.zeros((cases, instants, 2))
    los[1], los[3] = (100.0 + 3.0, 4.0), (100.0 - 3.0, -4.0)
    strehl = np.tile(np.linspace(0.5, 0.8, instants), (cases, 1))
    shake = disturbance == "shake"
    for array in (time, wfe, los, strehl):
        array[shake, 2:] = np.nan
        array[status != DONE] = np.nan
    ee80 = np.where(shake, np.inf, 1.25)
    axis = 0.25 * (np.arange(8) - 4)
    labels = {
        "case": np.arange(cases),
        "disturbance": ("case", disturbance),
        "realization": ("case", np.arange(cases) // 2),
        "axis": ["x", "y"],
        "x": axis,
        "y": axis,
    }
    study = {"study": {"name": HOSTILE, "seed": 7}, "telescope": {"name": "tmt-18"}}
    return xr.Dataset(
        {
            "time_s": (("case", "time"), time),
            "wfe_rms": (("case", "time"), 0.5 * wfe),
            "wfe_rms_raw": (("case", "time"), wfe),
            "segment_piston_rms": (("case", "time"), 0.25 * wfe),
            "los": (("case", "time", "axis"), los),
            "centroid": (("case", "time", "axis"), 0.1 * los),
            "strehl": (("case", "time"), strehl, {"long_name": "Strehl ratio <in some direction>"}),
            "ee50": ("case", np.full(cases, 0.6)),
            "ee80": ("case", ee80),
            "peak": ("case", np.where(shake, 0.2, 0.75)),
            "rayleigh": ("case", np.where(status == DONE, 0.25, np.nan)),
            "marechal": ("case", np.where(status == DONE, (np.arange(cases) < 3) * 1.0, np.nan)),
            "exposure": (("case", "y", "x"), np.full((cases, 8, 8), 0.01)),
            "status": ("case", status),
            "message": ("case", message),
        },
        coords=labels,
        attrs={
            "study": json.dumps(study),
            "versions": json.dumps({"numpy": "2.1"}),
            "device": "<cpu>",
            "study_title": "a <title> of a study",
            "seed": 7,
        },
    )
