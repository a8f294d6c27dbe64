"""Survey telescopes with lenses near their focus: Rubin, Subaru with HSC, Blanco with DECam, SDSS.

Their prescriptions are those of the public models of the program batoid (github.com/jmeyers314/batoid,
folder batoid/data). What shadows the light there is left out here, and M1 is the stop.
"""

from collections.abc import Mapping, Sequence
from math import inf, radians
from types import MappingProxyType

import numpy as np

from wavequake.optics.media.glasses import AIR, Medium, glass
from wavequake.optics.shapes.shapes import Conic, EvenAsphere, Opening, SurfaceAction
from wavequake.optics.systems.kinematics import SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil

_Line = tuple[str, float, float, float, tuple[float, ...], Medium | None]

# Of Schott's formula, through the model's indices at 400, 600, 750, 900 and 1100 nm.
_HSC_SILICA = (
    2.1043618625114,
    -0.0094555403568306,
    0.0085998817495411,
    0.00012824530059687,
    -1.7826350961509e-06,
)
_HSC_BSL7Y = (
    2.2733445767731,
    -0.010404935080044,
    0.010601743356846,
    0.00018265427074497,
    -1.6445989811433e-06,
)
_HSC_PBL1Y = (
    2.351984473394,
    -0.0085748451523554,
    0.015779477527969,
    0.00037271116643235,
    1.0458816304735e-05,
)


def rubin() -> OpticalSystem:
    """Return the survey telescope of the Rubin Observatory in the r band: three mirrors and lenses, f/1.23.

    The prescription is that of batoid's LSST_r: two concave aspheres on one substrate, a convex M2, lenses
    and a filter of fused silica.
    """
    silica = glass("SILICA")
    lines = [
        ("M1", 0.0, 19.835, -1.215, (0.0, 0.0, -1.381e-9), None),
        ("M2", 6.1562006, 6.788, -0.222, (0.0, 0.0, 1.274e-5, 9.68e-7), None),
        ("M3", -0.2338, 8.3445, 0.155, (0.0, 0.0, 4.5e-7, 8.15e-9), None),
        ("L1 front", 3.3974725882, 2.824, 0.0, (), silica),
        ("L1 back", 3.4797025882, 5.021, 0.0, (), AIR),
        ("L2 front", 3.8923446082, inf, 0.0, (), silica),
        ("L2 back", 3.9223446082, 2.529, -1.57, (0.0, 0.0, -0.001656), AIR),
        ("filter front", 4.2719246082, 5.632, 0.0, (), silica),
        ("filter back", 4.2898246082, 5.606, 0.0, (), AIR),
        ("L3 front", 4.3409246082, 3.169, -0.962, (), silica),
        ("L3 back", 4.4009246082, -13.36, 0.0, (), AIR),
        ("image", 4.4294246082, inf, 0.0, (), None),
    ]
    return _survey("rubin", lines, (8360.0, 0.612), 1.0, 622.0)


def hsc() -> OpticalSystem:
    """Return the Subaru telescope with Hyper Suprime-Cam: 8.2 m, prime focus, seven lenses, filter, window.

    The prescription is that of batoid's HSC. Its glasses are tables of indices at five wavelengths, which
    differ from those of the makers (BSL7Y by 9e-4): here they are sums of powers (Schott's formula) that
    have these indices there.
    """
    silica = _glass("silica of HSC", _HSC_SILICA)
    crown, flint = _glass("BSL7Y of HSC", _HSC_BSL7Y), _glass("PBL1Y of HSC", _HSC_PBL1Y)
    asphere = {
        "G1 back": (
            -0.14974887830730002,
            -0.07579068214673,
            -0.7705293869522001,
            10.26626319251,
            -70.78826218129001,
            255.96006178059997,
            -376.1551480577999,
        ),
        "G2 front": (
            0.06914718060975,
            0.603728126364,
            -15.326231734619999,
            361.8110894954,
            -4741.677881169,
            32173.090716919996,
            -88598.78091629999,
        ),
        "G3 front": (
            2.768476102307,
            -48.556420092589995,
            717.6113272765999,
            -10763.702614520002,
            118744.32178099999,
            -798382.1197395,
            2393556.961408,
        ),
        "G4 front": (
            -4.355533915492,
            36.358679149130005,
            -595.1267151922,
            7658.839741989,
            -71941.20343205,
            394282.0924898,
            -954342.843455,
        ),
        "G5 back": (
            -1.064687616564,
            3.377750239208,
            -110.26471335,
            2282.368582236,
            -27430.39658171,
            175577.1152898,
            -482194.9608578,
        ),
    }
    camera = [
        ("G1 front", 0.0, 0.76, silica),
        ("G1 back", 0.09718, 1.3755, AIR),
        ("G2 front", 0.47003, -3.53, crown),
        ("G2 back", 0.51603, 0.6562498974113357, AIR),
        ("ADC front", 0.83403, inf, crown),
        ("ADC crown back", 0.87403, 1.058, AIR),
        ("ADC flint front", 0.87703, 1.04, flint),
        ("ADC back", 0.95903, inf, AIR),
        ("G3 front", 1.23333, -0.840000170144847, flint),
        ("G3 back", 1.27333, 9.8, AIR),
        ("G4 front", 1.36333, 0.48, crown),
        ("G4 back", 1.46533, 4.021759021137413, AIR),
        ("G5 front", 1.56553, 4.176748363640779, silica),
        ("G5 back", 1.65353, -1.2728222984309576, AIR),
        ("filter front", 1.7435712564515065, inf, silica),
        ("filter back", 1.7585712564515065, inf, AIR),
        ("window front", 1.7910712564515065, inf, silica),
        ("window back", 1.8280712564515065, inf, AIR),
        ("image", 1.8430712564515065, inf, None),
    ]
    clear = dict.fromkeys(("G1 front", "G1 back"), 0.41)
    clear |= dict.fromkeys(("G2 front", "G2 back", "G3 front", "G3 back"), 0.32)
    clear |= dict.fromkeys(("ADC front", "ADC crown back", "ADC flint front", "ADC back"), 0.31)
    clear |= {"G4 front": 0.314, "G4 back": 0.314, "G5 front": 0.308, "G5 back": 0.308}
    lines = _prime_focus((30.0, -1.00835), 13.4564, camera, asphere)
    return _survey("hsc", lines, (8200.0, 0.1), 0.75, 750.0, clear)


def decam() -> OpticalSystem:
    """Return the Blanco telescope with the Dark Energy Camera: 4 m, prime focus, five lenses and a filter.

    The prescription is that of batoid's DECam; its index of fused silica is within 5e-6 of the one here.
    """
    silica = glass("SILICA")
    asphere = {
        "C2 back": (-0.1579446256981, -0.1042539517621, 0.135109615458),
        "C4 front": (0.1798202504605, 1.125897740959, 7.90699507906),
    }
    camera = [
        ("C1 front", 0.0, 0.685821, silica),
        ("C1 back", 0.1121, 0.711827, AIR),
        ("C2 front", 0.7642392828833, 3.38734554392779137, silica),
        ("C2 back", 0.8162392828833, 0.50705484897651434, AIR),
        ("C3 front", 0.9103579805596601, 0.944, silica),
        ("C3 back", 0.9860579805596601, 2.417, AIR),
        ("filter front", 1.4328576335828598, inf, silica),
        ("filter back", 1.4458576335828598, inf, AIR),
        ("C4 front", 1.5158576335828598, 0.66277857577089731, silica),
        ("C4 back", 1.6175189337539596, 1.7982, AIR),
        ("C5 front", 1.8198288249200602, -0.9, silica),
        ("C5 back", 1.8748288249200602, -0.685127, AIR),
        ("image", 1.9048288249200602, inf, None),
    ]
    clear = {"C1 front": 0.49, "C1 back": 0.46, "C2 front": 0.345, "C2 back": 0.3205, "C3 front": 0.323}
    clear |= {"C3 back": 0.313, "C4 front": 0.302, "C4 back": 0.295, "C5 front": 0.259, "C5 back": 0.271}
    lines = _prime_focus((21.3115998206672, -1.09763), 8.875055, camera, asphere)
    return _survey("decam", lines, (3942.0, 0.3), 1.1, 640.0, clear)


def sdss() -> OpticalSystem:
    """Return the 2.5 m telescope of the Sloan Digital Sky Survey with a corrector of three lenses, f/5.

    The prescription is that of batoid's SDSS: two aspheres, lenses of fused silica and a curved focal
    surface, 3 degrees across. (Gunn et al. 2006, Astron. J. 131, 2332, describe the telescope with earlier
    correctors.)
    """
    silica = glass("SILICA")
    l1 = (0.35905544482819999, 0.37894436573670002, 0.30570076741769999, 0.51457124513370004)
    l2 = (0.25093001062379997, 0.40104524984129998, -0.54679844739520004, 0.62072424640590002)
    lines = [
        ("M1", 0.0, 11.25163, -1.2859, (0.0, 0.0, -3.8140000000000002e-7, 1.5180000000000001e-8), None),
        ("M2", 3.64517, 7.19399, -11.977, (0.0, 0.0, -1.785e-4), None),
        ("L1 front", 0.09997089347400106, -0.6270209060833548, 0.0, l1, silica),
        ("L1 back", 0.04997089347400106, -1.3169479177459805, 0.0, (), AIR),
        ("L2 front", -0.40002910652599894, 0.6580063343341003, 0.0, (), silica),
        ("L2 back", -0.44002949019879907, 1.9631287985823387, 0.0, l2, AIR),
        ("L3 front", -0.64147978875519884, -2.4629369191936808, 0.0, (), silica),
        ("L3 back", -0.69147978875519884, inf, 0.0, (), AIR),
        ("image", -0.77647913119126514, 9.199322517101522, 0.0, (), None),
    ]
    clear = {"L1 front": 0.375, "L1 back": 0.36, "L2 front": 0.34, "L2 back": 0.355}
    clear |= {"L3 front": 0.355, "L3 back": 0.355}
    return _survey("sdss", lines, (2500.0, 0.48), 1.5, 620.0, clear)


def _glass(name: str, coefficients: tuple[float, ...]) -> Medium:
    """Return a medium by Schott's formula; coefficients that are not given are 0."""
    return Medium(name, "schott", (*coefficients, *[0.0] * (6 - len(coefficients))), (400.0, 1100.0))


def _prime_focus(
    mirror: tuple[float, float],
    at: float,
    camera: Sequence[tuple[str, float, float, Medium | None]],
    asphere: Mapping[str, tuple[float, ...]],
) -> list[_Line]:
    """Return the lines of a mirror (radius, conic) and of a camera that stands at a height above it.

    ``asphere`` has the coefficients of rho^4, rho^6, ... of the camera's surfaces that are no spheres.
    """
    lines: list[_Line] = [("M1", 0.0, *mirror, (), None)]
    for name, height, radius, medium in camera:
        powers = (0.0, *asphere[name]) if name in asphere else ()
        lines.append((name, at + height, radius, 0.0, powers, medium))
    return lines


def _survey(
    name: str,
    lines: Sequence[_Line],
    pupil: tuple[float, float],
    field_deg: float,
    wavelength_nm: float,
    clear: Mapping[str, float] = MappingProxyType({}),
) -> OpticalSystem:
    """Return a telescope from lines of name, height above M1, radius, conic, asphere and what follows.

    Lengths of a line are in m, coefficients of rho^2, rho^4, ... in m^-1, m^-3, ...; heights count from M1
    towards the sky, so that radii and powers change their signs here. What follows is a medium, or None for
    a mirror and the image. ``clear`` has the radii of lenses beyond which no light passes.
    """
    rows = []
    following = [line[1] for line in lines[1:]] + [lines[-1][1]]
    for (called, height, radius, conic, powers, medium), beyond in zip(lines, following, strict=True):
        even = tuple(-power * 1e-3 ** (2 * k - 1) for k, power in enumerate(powers, start=1))
        radius = -1e3 * radius if radius < inf else inf
        shape = EvenAsphere(radius, conic, even) if powers else Conic(radius, conic)
        action: SurfaceAction = "reflect" if medium is None else "refract"
        if called == "image":
            action = "pass"
        opening = Opening(1e3 * clear[called]) if called in clear else None
        way = 1e3 * (height - beyond)
        rows.append(SurfaceRow(called, shape, way, action, medium or AIR, opening=opening))
    left_out = "what shadows the light" if clear else "clear apertures and what shadows the light"
    return OpticalSystem(
        name=name,
        surfaces=sequential(rows),
        stop=0,
        pupil=Pupil("entrance_diameter", *pupil),
        fields=np.array([[0.0, 0.0], [0.0, radians(field_deg)]]),
        wavelengths=np.array([1e-6 * wavelength_nm]),
        note=f"Prescription of a public model; left out: {left_out}.",
    )
