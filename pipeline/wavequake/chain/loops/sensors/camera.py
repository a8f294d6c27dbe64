"""A camera on a guide star: the centre of gravity of the image on its pixels, as far as its window reaches.

Unlike the line of sight, the centroid of an image moves with coma and all else that is odd over the pupil,
and a window of pixels loses what is beyond it. It is linear in small aberrations of a perfect image; where
sensors see rays, it is that of the image which they make.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from wavequake.chain.loops.block import Photons, Sensor, register
from wavequake.chain.loops.light import Light, RayLight
from wavequake.errors import UserError
from wavequake.imaging.pupils.pupil_function import annular_pupil
from wavequake.mechanics.disturbances.motion import RAD_PER_MAS
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.prepared import prepared

Array = NDArray[np.float64]
# Nodes of Gauss and Legendre in a pixel: so many per wavelength / diameter, and so many more.
_PER_AIRY, _MORE = 2.0, 6
# Cells across the pupil, at least.
_CELLS = 256
# Points along one side of a window, for which there is memory and time.
_MOST = 4096


@dataclass(frozen=True)
class Window:
    """What a window of pixels makes of an image.

    Attributes
    ----------
    reads : ndarray, shape (2, J - 1)
        Centroid along x and y in mas per nm of Noll coefficients 2..J.
    spread : float
        Mean square of the places of its light along one axis, mas².
    share : float
        Of all light, what falls into it.
    """

    reads: Array
    spread: float
    share: float


@register
class Camera(Sensor):
    """The centroid along x and y, in mas, of the image of a star that the aperture's annulus makes."""

    units: ClassVar[str] = "mas"

    model: Literal["camera"] = "camera"
    photons: Photons = Field(default=0.0, description="of the star, per frame; 0: photons make no noise")
    read_noise: float = Field(default=0.0, ge=0, le=1e6, description="electrons rms per pixel, with photons")
    pixel_mas: float = Field(default=5.0, gt=0, le=1e6, description="width of a pixel on the sky")
    pixels: int = Field(default=16, ge=2, le=128, description="along one side of the window")

    def labels(self, light: Light) -> tuple[str, ...]:
        """Return x and y."""
        return ("x", "y")

    def matrix(self, light: Light, nominal: bool = False) -> Array:
        """Return the centroid of what is seen, (2, J - 1).

        Raises
        ------
        UserError
            If what is seen has no wavelength, so that there is no image, or the window too many points.
        """
        return self._window(light).reads @ light.noll

    def of_rays(self, light: Light, rays: RayLight) -> Array:
        """Return the centroids of images that rays make, (2, batch)."""
        nodes = _nodes(self.pixel_mas, self.pixels, self._points(light))
        turn = 2 * np.pi / (light.wavelength_nm * 1e-6) * RAD_PER_MAS
        along_x, along_y = (np.exp(-1j * turn * np.outer(one, nodes.at)) for one in (rays.x, rays.y))
        found = np.empty((2, len(rays.phase)))
        for k, phase in enumerate(rays.phase):
            field = along_y.T @ ((rays.weight * np.exp(2j * np.pi * phase))[:, None] * along_x)
            image = nodes.width[:, None] * (field.real**2 + field.imag**2) * nodes.width
            found[:, k] = image.sum(axis=0) @ nodes.where, image.sum(axis=1) @ nodes.where
            found[:, k] /= image.sum()
        return found

    def noise_rms(self, light: Light) -> float:
        """Return that of the sensor, of photons and of pixels: sqrt(s² / N + (r / N)² sum of x²)."""
        own = super().noise_rms(light)
        if not self.photons:
            return own
        found = self._window(light)
        places = _places(self.pixels, self.pixel_mas)
        inside = found.share * self.photons
        of_pixels = (self.read_noise / inside) ** 2 * self.pixels * float(places @ places)
        return float(np.sqrt(own**2 + found.spread / inside + of_pixels))

    def _window(self, light: Light) -> Window:
        if not light.wavelength_nm:
            raise UserError(
                f"sensor.{self.name}: nothing here has a wavelength, so that a camera has no image; take "
                "line-of-sight."
            )
        points = self._points(light)
        if self.pixels * points > _MOST:
            most = self.pixel_mas * _MOST / (self.pixels * points)
            raise UserError(
                f"sensor.{self.name}: {self.pixels} pixels of {self.pixel_mas:g} mas are too many for images "
                f"that fine; take pixel_mas = {most:.2g} or less, or fewer pixels."
            )
        return _window(
            light.terms,
            light.obscuration,
            light.radius_mm,
            light.wavelength_nm,
            self.pixel_mas,
            self.pixels,
            points,
        )

    def _points(self, light: Light) -> int:
        """Return the nodes along one side of a pixel."""
        airy = light.wavelength_nm * 1e-6 / (2 * light.radius_mm) / RAD_PER_MAS
        return int(np.ceil(_PER_AIRY * self.pixel_mas / airy)) + _MORE


@dataclass(frozen=True)
class _Nodes:
    """Nodes along one side of a window: places, widths, and middles of their pixels, mas."""

    at: Array
    width: Array
    where: Array


def _nodes(pixel_mas: float, pixels: int, points: int) -> _Nodes:
    nodes, shares = np.polynomial.legendre.leggauss(points)
    middles = _places(pixels, pixel_mas)
    at = (middles[:, None] + 0.5 * pixel_mas * nodes).ravel()
    return _Nodes(at, np.tile(0.5 * pixel_mas * shares, pixels), np.repeat(middles, points))


def _places(pixels: int, pixel_mas: float) -> Array:
    return np.asarray((np.arange(pixels) - (pixels - 1) / 2) * pixel_mas)


@prepared(maxsize=8)
def _window(
    terms: int,
    obscuration: float,
    radius_mm: float,
    wavelength_nm: float,
    pixel_mas: float,
    pixels: int,
    points: int,
) -> Window:
    """Return the window of a perfect image.

    The derivative of the centroid sum(x I) / sum(I) by a phase is 2 Re(i P B) / sum(I), B the transform of
    x conj(E) back to the pupil P: one transform for all polynomials.
    """
    # Phase in rad per radius of the pupil and mas; the image goes where the optical path falls.
    turn = 2 * np.pi / (wavelength_nm * 1e-6) * radius_mm * RAD_PER_MAS
    half = 0.5 * pixels * pixel_mas
    pupil = annular_pupil(max(_CELLS, int(np.ceil(turn * half))), obscuration)
    nodes = _nodes(pixel_mas, pixels, points)
    width, where = nodes.width, nodes.where
    kernel = np.exp(1j * turn * np.outer(pupil.axis, nodes.at))
    field = kernel.T @ pupil.amplitude @ kernel
    light = width[:, None] * (field.real**2 + field.imag**2) * width
    total = light.sum()
    basis = annular_zernike(pupil.x, pupil.y, terms, obscuration)[:, 1:]
    rows = []
    for along_y, along_x in ((width, width * where), (width * where, width)):
        back = (kernel @ (along_y[:, None] * field.conj() * along_x) @ kernel.T).ravel()[pupil.cells]
        by_phase = 2 * np.real(1j * pupil.light * back) / total
        rows.append(2 * np.pi / wavelength_nm * (by_phase @ basis))
    step = pupil.axis[1] - pupil.axis[0]
    # By Parseval's theorem, of one period of the sampled field.
    everything = np.sum(pupil.amplitude**2) * (2 * np.pi / (turn * step)) ** 2
    return Window(np.array(rows), float((light @ where**2).sum() / total), float(total / everything))
