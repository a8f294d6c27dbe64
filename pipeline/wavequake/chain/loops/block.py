"""What sensors, actuators and controllers offer, and their registries: one file adds a kind of one."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationError

from wavequake.campaign.schema import Section
from wavequake.chain.loops.answers import OwnModes
from wavequake.chain.loops.design import Design
from wavequake.chain.loops.light import Light, RayLight
from wavequake.control.sampled.channel import RIGID, Dynamics, first_order, second_order
from wavequake.control.sampled.regulator import Instant, Regulator, Stepped
from wavequake.errors import UserError
from wavequake.mechanics.disturbances.source import AnySource
from wavequake.optics.systems.system import States
from wavequake.registry import Registry

Array = NDArray[np.float64]

Varied = Annotated[tuple[float | str, ...], Field(strict=False)]
_NAMED = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"


def zero_or_more(least: float) -> Callable[[float], float]:
    """Return what refuses numbers between 0 and the least one that means something."""

    def check(value: float) -> float:
        if 0 < value < least:
            raise ValueError(f"it is {value:g}; give 0, or {least:g} or more")
        return value

    return check


Photons = Annotated[float, Field(ge=0, le=1e18), AfterValidator(zero_or_more(1e-3))]


def each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return names, of which none is there twice."""
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{twice!r} is named twice")
    return names


class Sensor(Section):
    """A sensor that averages over its frames; a study file names it by the default of its field ``model``."""

    units: ClassVar[str]
    sees: ClassVar[Literal["light", "bodies"]] = "light"

    name: str = Field(pattern=_NAMED, description="also names its random numbers")
    rate_hz: float = Field(default=1000.0, gt=0, le=1e5, description="frames per second")
    integration: float = Field(
        default=1.0, ge=1e-4, le=1, description="last share of a frame over which it averages"
    )
    noise: float = Field(
        default=0.0, ge=0, le=1e12, description="rms of each reading, per frame, in its unit"
    )
    noise_density: float = Field(
        default=0.0, ge=0, le=1e12, description="one-sided, in its unit per root of Hz, beside `noise`"
    )
    quantum: Annotated[float, AfterValidator(zero_or_more(1e-15))] = Field(
        default=0.0, ge=0, le=1e12, description="step to which readings are rounded; 0: none"
    )
    bandwidth_hz: float | None = Field(
        default=None,
        ge=1e-3,
        le=1e6,
        description="of its electronics, of first order; default: no limit",
    )

    def dynamics(self) -> Dynamics:
        """Return how a reading follows what is read."""
        return RIGID if self.bandwidth_hz is None else first_order(self.bandwidth_hz)

    @abstractmethod
    def labels(self, light: Light) -> tuple[str, ...]:
        """Return the names of its m readings."""

    @abstractmethod
    def matrix(self, light: Light, nominal: bool = False) -> Array:
        """Return readings per what of it is seen, (m, J - 1) or (m, 3 S or more): as they are or believed."""

    def readings(self, light: Light, nominal: bool = False) -> Array:
        """Return readings per all that is seen, (m, K)."""
        found, rest = self.matrix(light, nominal), len(light) - light.optical
        if self.sees == "light":
            return np.pad(found, ((0, 0), (0, rest)))
        return np.pad(found, ((0, 0), (light.optical, rest - found.shape[1])))

    def of_rays(self, light: Light, rays: RayLight) -> Array | None:
        """Return readings (m, batch) of rays; by default None: those of line of sight and coefficients do."""
        return None

    def noise_rms(self, light: Light) -> float:
        """Return the standard deviation of a reading of one frame."""
        exposed = self.integration / self.rate_hz
        return float(np.hypot(self.noise, self.noise_density / np.sqrt(2 * exposed)))


class Centroids(Section):
    """What makes the noise of a centroid; without photons it has none."""

    photons: Photons = Field(default=0.0, description="in a spot, per frame; 0: photons make no noise")
    read_noise: float = Field(default=0.0, ge=0, le=1e6, description="electrons rms per pixel")
    spot_mas: float = Field(default=20.0, gt=0, le=1e9, description="rms width of the spot along one axis")
    pixel_mas: float = Field(
        default=20.0, gt=0, le=1e9, description="width of a pixel of the detector on the sky"
    )
    pixels: int = Field(default=8, ge=2, le=64, description="along one side of the window")

    def centroid_rms(self) -> float:
        """Return the rms of a centre of gravity along one axis, mas.

        Of N photons at places of variance s^2 it is s / sqrt(N); read noise r of every pixel adds
        r^2 sum(x^2) / N^2 to the square.
        """
        if not self.photons:
            return 0.0
        places = (np.arange(self.pixels) - (self.pixels - 1) / 2) * self.pixel_mas
        spread = self.pixels * float(places @ places)
        return float(
            np.sqrt(self.spot_mas**2 / self.photons + (self.read_noise / self.photons) ** 2 * spread)
        )


class Actuator(Section):
    """An actuator; a study file names it by the default of its field ``model``."""

    # Half width of central differences in its units.
    step: ClassVar[float] = 10.0

    name: str = Field(pattern=_NAMED, description="by which a [[controller]] or [[loop]] says what it moves")
    bandwidth_hz: float | None = Field(
        default=None, ge=1e-3, le=1e6, description="of first order; default: it follows at once"
    )
    resonance_hz: float | None = Field(
        default=None, ge=1e-3, le=1e6, description="of second order, in place of it"
    )
    damping: float = Field(default=0.7, gt=0, le=10, description="damping ratio of the resonance")
    stroke: float | None = Field(default=None, gt=0, description="largest position; default: no limit")
    slew: float | None = Field(
        default=None, gt=0, description="largest change per second, from one command to the next"
    )
    stuck: dict[str, float] = Field(
        default_factory=dict, description="channels that do not move, and where they stand"
    )

    @property
    def mirror_terms(self) -> int:
        """Noll terms by which it deforms M2; 0: none."""
        return 0

    @property
    def segment_dofs(self) -> tuple[int, ...]:
        """Degrees of freedom (0 to 5: dx ... rz) in which it moves every segment of M1."""
        return ()

    @property
    def carried_kg(self) -> float | None:
        """Mass of each thing that it moves, which pushes back what carries that; None: not known."""
        return None

    @abstractmethod
    def channels(self, light: Light) -> tuple[str, ...]:
        """Return the names of its p channels."""

    @abstractmethod
    def put(self, light: Light, states: States, positions: Array) -> None:
        """Add positions (batch, p) to the first instants of a telescope's states."""

    def motion(self, positions: Array) -> dict[str, Array]:
        """Return motions (n, 6) in m and rad of elements of any system by name, at positions (n, p).

        Raises
        ------
        UserError
            If it moves what only segmented telescopes have.
        """
        model = type(self).model_fields["model"].default
        raise UserError(
            f"actuator.{self.name}: {model} moves a segmented telescope; here a surface or body is moved by "
            'model = "optic".'
        )

    def own_modes(self) -> OwnModes | None:
        """Return the modes of what it moves; None: that is stiff, and follows as the channels do."""
        return None

    def dynamics(self) -> Dynamics:
        """Return how a channel follows."""
        if self.resonance_hz is not None:
            if self.bandwidth_hz is not None:
                raise UserError(f"actuator.{self.name}: give bandwidth_hz or resonance_hz, not both.")
            return second_order(self.resonance_hz, self.damping)
        return RIGID if self.bandwidth_hz is None else first_order(self.bandwidth_hz)


class Controller(Section):
    """A controller; a study file names it by the default of its field ``model``."""

    # Whether it takes several sensors.
    fuses: ClassVar[bool] = False

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_./-]*$", description="of its cases in tables and figures"
    )
    sensor: str = Field(default="", description="name of its [[sensor]]")
    actuator: str = Field(default="", description="name of its [[actuator]]")
    also_reads: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="further sensors, of the same frames, of a controller that takes several; their readings "
        "come after those of the first",
    )
    rate_hz: float | None = Field(
        default=None, gt=0, description="commands per second, of the mean of frames; default: every frame"
    )
    latency_frames: float = Field(
        default=1.0,
        ge=0,
        le=100,
        description="from the end of the last frame to the command's acting, in its own periods; any "
        "fraction; 0: in the next one",
    )
    beside: tuple[str, ...] = Field(
        default=(), strict=False, description="other controllers that run at the same time"
    )
    vary: dict[str, Varied] = Field(
        default_factory=dict,
        strict=False,
        description="values of other keys, as latency_frames = [0, 1]: a controller of every combination, "
        "called name/value/value",
    )

    def varied(self) -> "tuple[Controller, ...]":
        """Return the controllers that it stands for: itself, or those of all its varied values.

        Raises
        ------
        ValueError
            If a key is none of its own, or a value does not fit it.
        """
        if not self.vary:
            return (self,)
        fields = set(type(self).model_fields) - {"vary", "name", "model"}
        if unknown := next((key for key in self.vary if key not in fields), None):
            raise ValueError(f"the controller {self.name!r} varies {unknown!r}, which is none of its keys")
        if empty := next((key for key, values in self.vary.items() if not values), None):
            raise ValueError(f"the controller {self.name!r} varies {empty!r} over no values")
        fixed = self.model_dump(exclude_unset=True, exclude={"vary"})
        found = []
        for values in product(*self.vary.values()):
            words = [one if isinstance(one, str) else f"{one:g}" for one in values]
            own = fixed | dict(zip(self.vary, values, strict=True)) | {"name": "/".join([self.name, *words])}
            try:
                found.append(type(self).model_validate(own, strict=False))
            except ValidationError as error:
                key, why = error.errors()[0]["loc"][0], error.errors()[0]["msg"]
                raise ValueError(f"the controller {own['name']!r}: {key}: {why}") from None
        return tuple(found)

    @property
    def asks_modes(self) -> bool:
        """Whether it takes the modes of bodies as disturbances shake them, which are drawn for it."""
        return False

    def notices(self, asked: Design) -> Iterator[str]:
        """Yield what the user should know of its design before a run; by default nothing."""
        yield from ()

    @abstractmethod
    def design(self, asked: Design) -> Regulator | Stepped | Instant | None:
        """Return what gives the commands; None: nothing moves.

        Raises
        ------
        UserError
            If there is none for this sensor and actuator.
        """


Kind = TypeVar("Kind", bound=type[Section])
_HOME = "wavequake.chain.loops"


def _registry(what: str) -> Registry[Any]:
    return Registry(
        what,
        f"{_HOME}.{what}s",
        f"wavequake.{what}s",
        lambda entry: str(entry.model_fields["model"].default),
    )


SENSORS, ACTUATORS, CONTROLLERS = map(_registry, ("sensor", "actuator", "controller"))


def register(kind: Kind) -> Kind:
    """Make a sensor, actuator or controller known to study files; a decorator of its class.

    Raises
    ------
    UserError
        If it is none of the three, or another one has its name.
    """
    for base, registry in ((Sensor, SENSORS), (Actuator, ACTUATORS), (Controller, CONTROLLERS)):
        if isinstance(kind, type) and issubclass(kind, base):
            registry.add(kind)
            return kind
    raise UserError(f"{kind!r} is no sensor, actuator or controller; derive it from one of them.")


class AnyBlock(AnySource):
    """Annotates a field of a study that takes any entry of a registry."""

    def __init__(self, registry: Registry[Any]) -> None:
        self._registry = registry

    def models(self) -> tuple[Any, ...]:
        """Return the models among which the key ``model`` chooses."""
        return tuple(entry for _, entry in sorted(self._registry.entries().items()))


def stroke_of(actuator: Actuator, count: int) -> Array:
    """Return the largest positions (p,) of an actuator."""
    return np.full(count, np.inf if actuator.stroke is None else actuator.stroke)


def stuck_of(actuator: Actuator, channels: tuple[str, ...]) -> Array:
    """Return where channels are stuck (p,), NaN for those that move.

    Raises
    ------
    UserError
        If there is no such channel.
    """
    found = np.full(len(channels), np.nan)
    for name, value in actuator.stuck.items():
        if name not in channels:
            raise UserError(
                f"actuator.{actuator.name}.stuck: there is no channel {name!r}; it has {channels[0]} to "
                f"{channels[-1]}."
            )
        found[channels.index(name)] = value
    return found
