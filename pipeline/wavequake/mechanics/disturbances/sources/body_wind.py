"""Wind on bodies: gusts that push nodes of a structure, coherent where the nodes are near each other."""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.mechanics.assembly.answers import Shaking, over_time
from wavequake.mechanics.assembly.plant import Plant
from wavequake.mechanics.disturbances.plant_source import PlantSource, bands_about, harmonics
from wavequake.mechanics.disturbances.source import register
from wavequake.mechanics.disturbances.sources.body_force import Direction, unit
from wavequake.mechanics.disturbances.spectra import scaled, von_karman
from wavequake.mechanics.disturbances.streams import Random

Array = NDArray[np.float64]


@register
class BodyWind(PlantSource):
    """Gusts on nodes of bodies: force = density x drag x area x mean speed x gust, along the wind.

    That is the fluctuating part of the drag to first order in the gust; the mean force is left to the
    alignment. Gusts have the von Karman spectrum, averaged over the area of each node, and between nodes d
    apart the coherence exp(-C f d / U).
    """

    model: Literal["body-wind"] = "body-wind"
    areas_m2: dict[str, Annotated[float, Field(gt=0)]] = Field(
        min_length=1, description="that nodes show to the wind, by body.node: { 'tube.top1' = 0.2 }"
    )
    direction: Direction = Field(
        default=(1.0, 0.0, 0.0), description="of the wind, in the axes of the system"
    )
    mean_speed_m_s: float = Field(default=5.0, gt=0, le=100, description="U, of the wind over all nodes")
    turbulence_intensity: float = Field(
        default=0.2, gt=0, le=2, description="rms of the gusts over the mean speed"
    )
    length_scale_m: float = Field(default=20.0, gt=0, description="L, integral scale of the turbulence")
    air_density_kg_m3: float = Field(default=1.2, gt=0, description="of the air; 1.2: at sea level")
    drag_coefficient: float = Field(default=1.2, gt=0, description="1.2: round tubes")
    coherence_decay: float = Field(default=10.0, gt=0, description="C of the coherence exp(-C f d / U)")

    @model_validator(mode="after")
    def _blows(self) -> Self:
        unit(self.direction)
        return self

    def answer(self, plant: Plant, time: Array, random: Random) -> Array:
        """Return the steady vibration under one realization of the gusts."""
        columns = [self.place(plant, at, "force") for at in self.areas_m2]
        areas = np.array(list(self.areas_m2.values()))
        points = np.stack([plant.points[at] for at in self.areas_m2])
        onto = np.zeros((len(columns), plant.modal.inputs.shape[1]))
        for row, part in enumerate(columns):
            onto[row, part] = unit(self.direction)
        pressure = self.air_density_kg_m3 * self.drag_coefficient * self.mean_speed_m_s
        gusts = von_karman(
            self.turbulence_intensity * self.mean_speed_m_s, self.length_scale_m, self.mean_speed_m_s
        )
        omega, drawn = harmonics(bands_about(plant, scaled(gusts, pressure**2)), random, len(columns))
        frequency = omega / (2.0 * np.pi)
        forces = (
            areas
            * averaged(frequency[:, None], areas, self.mean_speed_m_s)
            * drawn_coherent(drawn, coherence(self, points, frequency))
        )
        return over_time(plant, Shaking(omega, forces @ onto), time)


def averaged(frequency_hz: Array, area_m2: Array, speed_m_s: float) -> Array:
    """Return what averaging over an area leaves of amplitudes of gusts, 1 / (1 + (2 f sqrt(A)/U)^(4/3))."""
    return np.asarray(1.0 / (1.0 + (2.0 * frequency_hz * np.sqrt(area_m2) / speed_m_s) ** (4.0 / 3.0)))


def coherence(wind: BodyWind, points: Array, frequency_hz: Array) -> Array:
    """Return exp(-C f d / U) between points (k, 3) in m, at each frequency: (f, k, k)."""
    away = np.linalg.norm(points[:, None] - points, axis=2)
    return np.asarray(
        np.exp(-wind.coherence_decay / wind.mean_speed_m_s * frequency_hz[:, None, None] * away)
    )


def drawn_coherent(drawn: NDArray[np.complex128], coherences: Array) -> NDArray[np.complex128]:
    """Return independent amplitudes (f, k) as ones that have the given coherence (f, k, k)."""
    powers, shapes = np.linalg.eigh(coherences)  # no Cholesky factor where points are near each other
    roots = shapes * np.sqrt(np.maximum(powers, 0.0))[:, None, :]
    return np.asarray(np.einsum("fkj,fj->fk", roots, drawn))
