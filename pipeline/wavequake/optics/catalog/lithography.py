"""A bundled objective for lithography with extreme ultraviolet light."""

import numpy as np

from wavequake.optics.shapes.shapes import EvenAsphere
from wavequake.optics.systems.kinematics import SurfaceRow, sequential
from wavequake.optics.systems.system import OpticalSystem, Pupil

# Name, radius, way along z to the next surface (mm), coefficients of rho^4, rho^6 ... rho^14.
_MIRRORS = (
    (
        "M1",
        -681.0787850,
        -167.042360,
        (
            3.428332851e-09,
            -8.128235403e-14,
            2.322268898e-18,
            3.902970172e-24,
            -8.411756257e-27,
            4.726598347e-31,
        ),
    ),
    (
        "M2",
        -10971.0007243,
        412.942058,
        (
            -2.594745720e-09,
            -4.640937439e-13,
            5.990614414e-16,
            -8.308124030e-19,
            5.656933285e-22,
            -1.547087445e-25,
        ),
    ),
    (
        "M3",
        885.3840790,
        -304.700733,
        (
            -6.732591326e-10,
            2.987936567e-15,
            -1.201147139e-19,
            5.663162743e-24,
            -6.985103058e-29,
            -7.989365444e-34,
        ),
    ),
    (
        "M4",
        702.3955738,
        998.873134,
        (
            -3.516389469e-11,
            5.364646794e-16,
            -6.514605569e-21,
            4.234628593e-26,
            -1.475132772e-31,
            3.204269206e-37,
        ),
    ),
    (
        "M5",
        312.5823163,
        -568.026304,
        (
            -1.215668566e-09,
            6.271064442e-13,
            -1.304155548e-17,
            -1.160915744e-20,
            4.080701871e-24,
            -5.473261074e-28,
        ),
    ),
    (
        "M6",
        651.2714831,
        610.665474,
        (
            2.138672993e-11,
            6.711965316e-17,
            3.082072229e-22,
            -4.298932917e-27,
            9.918772594e-32,
            -7.574549339e-37,
        ),
    ),
)


def euv() -> OpticalSystem:
    """Return a projection objective of six aspheres like those for EUV light: 4x reduction, NA 0.25, 13.5 nm.

    The design is our own, not that of a machine. Of random coaxial layouts with the stop on M2, a flat image
    (the powers sum up to zero) and an image-side NA of 0.25 those were kept in which no mirror stands in the
    beam; then radii, spacings and aspheres were fitted to a sharp image by real rays. It images a ring field:
    117 to 123 mm from the axis on the mask, a ring 1.5 mm wide on the wafer. There the wavefront error is
    0.01 to 0.023 waves rms, the distortion less than 10 nm; chief rays are telecentric to 10 mrad at the
    wafer and lean by 7.5 degrees at the reflecting mask. NA 0.25 is the paraxial one, of the axis; in the
    ring the real cone is 0.243 wide across and 0.235 along the radius. Beams pass the mirrors at 4 mm or more
    in the meridional plane. Mask and wafer are 1572 mm apart.
    """
    rows = [
        SurfaceRow(name, EvenAsphere(radius, 0.0, (0.0, *coefficients)), way, "reflect")
        for name, radius, way, coefficients in _MIRRORS
    ]
    return OpticalSystem(
        name="euv",
        surfaces=sequential([*rows, SurfaceRow("wafer image")]),
        stop=1,
        pupil=Pupil("image_na", 0.25),
        object_distance=589.325266,
        fields=np.array([[0.0, 117.0], [0.0, 120.0], [0.0, 123.0]]),
        wavelengths=np.array([13.5e-6]),
        note="A design of our own, not that of any machine.",
    )
