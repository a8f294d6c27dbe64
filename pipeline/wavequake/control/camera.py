"""The camera at the screen: rendered frames, center of intensity, calibration (Störkle 2018, Sec. 5.2.5)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavequake.control.linear import Array
from wavequake.errors import UserError


@dataclass(frozen=True)
class Camera:
    """Parameters; lengths in m on the screen.

    Attributes
    ----------
    columns, rows : int
        Of the area of interest.
    pixel : float
        Side of a pixel, on the screen.
    spot_radius : float
        Of the light point.
    blur : float
        Width of its edge.
    level : float
        Gray value of the light point, at most 255.
    read_noise : float
        Standard deviation of a gray value.
    threshold : float
        Gray values below count as dark.
    rate : float
        Frames per s.
    distortion : float
        Cubic term: a point at x shows at x (1 + distortion (x / half width)²).
    unsteadiness : float
        Standard deviation of a light point's position that is not its own: air, exposure, video compression.
    """

    columns: int = 800
    rows: int = 200
    pixel: float = 17e-6
    spot_radius: float = 2.5e-3
    blur: float = 60e-6
    level: float = 200.0
    read_noise: float = 2.0
    threshold: float = 40.0
    rate: float = 200.0
    distortion: float = -0.01
    unsteadiness: float = 20e-6

    def __post_init__(self) -> None:
        if min(self.columns, self.rows, self.pixel, self.spot_radius, self.blur, self.rate) <= 0:
            raise UserError("The camera's sizes, blur and frame rate must be positive.")
        if not 0 < self.threshold < self.level <= 255:
            raise UserError("The camera's threshold must lie between 0 and its level, that at most at 255.")


def _on_sensor(camera: Camera, position: Array) -> Array:
    """Return where a point at `position` (m from the middle) shows, in pixels from the first one's center."""
    half = camera.columns * camera.pixel / 2
    seen = position * (1 + camera.distortion * (position / half) ** 2)
    return np.asarray(seen / camera.pixel + (camera.columns - 1) / 2)


def render(camera: Camera, position: ArrayLike, noise: Array | None = None) -> NDArray[np.uint8]:
    """Return frames (f, rows, columns) of 8-bit gray values for light points at `position` (f,) in m.

    `noise` is standard normal, of the frames' shape. The spot's edge is a smooth step of width `blur`.
    """
    at = _on_sensor(camera, np.atleast_1d(np.asarray(position, dtype=np.float64)))
    across = (np.arange(camera.columns) - at[:, None]) * camera.pixel
    up = (np.arange(camera.rows) - (camera.rows - 1) / 2) * camera.pixel
    distance = np.hypot(up[None, :, None], across[:, None, :])
    gray = camera.level * _edge((camera.spot_radius - distance) / camera.blur)
    if noise is not None:
        gray = gray + camera.read_noise * noise
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def _edge(inside: Array) -> Array:
    """Return a smooth step from 0 to 1 about 0, of width 1."""
    return np.asarray(0.5 + 0.5 * np.tanh(2 * inside))


def center_of_intensity(camera: Camera, frames: NDArray[np.uint8]) -> Array:
    """Return the column center of all light above the threshold, in pixels, per frame (Eq. 5.15).

    Raises
    ------
    UserError
        If a frame is dark; says which.
    """
    bright = np.where(frames >= camera.threshold, frames, 0)
    columns = bright.sum(axis=-2, dtype=np.float64)
    total = columns.sum(axis=-1)
    if not (total > 0).all():
        raise UserError(f"Frame {int(np.argmin(total > 0))} is dark: no pixel reaches the threshold.")
    return np.asarray((columns * np.arange(camera.columns)).sum(axis=-1) / total)


@dataclass(frozen=True)
class Calibration:
    """Image positions in m, rising, and the centers in pixels at which they show (Fig. 5.24)."""

    position: Array
    center: Array


def calibrate(
    camera: Camera, steps: ArrayLike, sensitivity: float, noise: Array | None = None
) -> Calibration:
    """Move lens 5 by known steps and record where the light point shows.

    The image moves by the sensitivity of lens 5, the lens that the stage moves, times its step.

    Parameters
    ----------
    camera : Camera
    steps : array_like, shape (k,)
        Positions of the stage in m, rising; at least two.
    sensitivity : float
        Of the lens that is moved.
    noise : ndarray, shape (k, rows, columns), optional
        Standard normal.

    Raises
    ------
    UserError
        If the light point's centers do not rise with the steps.
    """
    image = sensitivity * np.asarray(steps, dtype=np.float64)
    center = center_of_intensity(camera, render(camera, image, noise))
    if len(image) < 2 or (np.diff(image) <= 0).any() or (np.diff(center) <= 0).any():
        raise UserError("The camera's calibration needs at least two rising steps within its view.")
    return Calibration(image, center)


def image_position(calibration: Calibration, center: ArrayLike) -> Array:
    """Return image positions in m for centers in pixels, between the steps of the calibration.

    Beyond them the last two steps go on straight.
    """
    at, known = np.asarray(center, dtype=np.float64), calibration
    place = np.clip(np.searchsorted(known.center, at) - 1, 0, len(known.center) - 2)
    slope = np.diff(known.position)[place] / np.diff(known.center)[place]
    return np.asarray(known.position[place] + slope * (at - known.center[place]))


@dataclass(frozen=True)
class CameraError:
    """What the camera with its calibration adds to image positions: bias over position, and noise, in m."""

    position: Array
    bias: Array
    noise: float


def camera_error(camera: Camera, calibration: Calibration, rng: np.random.Generator) -> CameraError:
    """Render light points over the field, measure them, and return bias and noise of what was found.

    A campaign of thousands of runs adds these instead of rendering every frame anew.
    """
    reach = float(calibration.position[-1])
    position = np.linspace(-reach, reach, 25)
    bias, spread = np.empty(len(position)), np.empty(len(position))
    for place, point in enumerate(position):
        noise = rng.standard_normal((2, camera.rows, camera.columns))
        found = image_position(
            calibration, center_of_intensity(camera, render(camera, np.full(2, point), noise))
        )
        bias[place], spread[place] = found.mean() - point, np.diff(found)[0] / np.sqrt(2)
    return CameraError(position, bias, float(np.hypot(np.sqrt(np.mean(spread**2)), camera.unsteadiness)))


def camera_reading(error: CameraError, position: Array, noise: Array) -> Array:
    """Return what the camera takes for image positions in m; `noise` is standard normal."""
    return np.asarray(position + np.interp(position, error.position, error.bias) + error.noise * noise)
