"""An elastic M2 on actuators: a finite-element disc whose modes answer commands, statics exact."""

from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from scipy.spatial import KDTree

from wavequake.chain.loops.actuators.m2_figure import MM_PER_NM
from wavequake.chain.loops.answers import OwnModes
from wavequake.chain.loops.block import Actuator, register
from wavequake.chain.loops.light import Light
from wavequake.control.sampled.channel import recoil
from wavequake.errors import UserError
from wavequake.mechanics.mirrors.material import Material
from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror, on_springs
from wavequake.mechanics.model import FiniteElementModel
from wavequake.optics.polynomials.zernike import MOST_TERMS, annular_zernike
from wavequake.optics.segments.telescope import M2
from wavequake.optics.systems.system import States
from wavequake.prepared import prepared
from wavequake.reduction.metrics import modal_form
from wavequake.reduction.reduce import reduce
from wavequake.reduction.structure import elastic_flexibility, structure

Array = NDArray[np.float64]
_HZ = 1.0 / (2 * np.pi)


class Bending(NamedTuple):
    """What an elastic mirror does with the ends of its actuators.

    ``static`` are Noll coefficients of the surface at rest per command, (p, terms); ``hertz`` those of modes;
    ``drives`` what of a command goes into each, (M, p); ``shapes`` their Noll coefficients, (M, terms).
    """

    static: Array
    hertz: Array
    drives: Array
    shapes: Array


@register
class ElasticM2(Actuator):
    """M2 as a disc of finite elements that stands on actuators with stiffness, in rings on its rear.

    A command moves the far end of an actuator's spring along z, nm. At rest the surface is that of all
    degrees of freedom; the modes of a reduced model answer what is faster: they lag and ring, and couple
    channels. The disc is as wide as the beam's footprint. What it pushes against stands still.
    """

    model: Literal["m2-body"] = "m2-body"
    rings: int = Field(
        default=4, ge=1, le=20, description="of actuators about one in the middle, 6 k in ring k"
    )
    stiffness_n_um: float = Field(
        default=10.0, ge=1e-9, le=1e9, description="of an actuator, along x, y and z alike, N/um"
    )
    diameter_m: float = Field(default=3.0244, ge=1e-3, le=100, description="of the disc; default: TMT's M2")
    thickness_m: float = Field(
        default=0.04, ge=1e-5, le=10, description="of the disc, the same everywhere; 40 mm is an example"
    )
    radius_m: float | None = Field(
        default=None,
        ge=-1e9,
        le=1e9,
        description="vertex radius of curvature; negative: convex; default: flat",
    )
    young_gpa: float = Field(
        default=90.3, ge=1e-6, le=1e6, description="of glass ceramic, as the two that follow"
    )
    poisson: float = Field(
        default=0.24, gt=-1, lt=0.5, description="Poisson's ratio of the disc; default: glass ceramic"
    )
    density_kg_m3: float = Field(
        default=2530.0, ge=1.0, le=1e6, description="of the disc; default: glass ceramic"
    )
    divisions: int = Field(default=6, ge=2, le=20, description="elements along half a radius")
    reduction: str = Field(
        default="modal40",
        description="reduced model whose modes move, by method and order, as modal40",
    )
    zeta: float = Field(default=0.01, ge=1e-9, lt=1, description="damping ratio of every mode")
    terms: int = Field(
        default=105, ge=3, le=MOST_TERMS, description="Noll terms by which surfaces are described"
    )

    @model_validator(mode="after")
    def _can_be_built(self) -> "ElasticM2":
        try:
            places = _model(*self._body()).interfaces
        except UserError as error:
            raise ValueError(f"the actuator {self.name!r}: {error}") from None
        if len(set(places.tolist())) < len(places):
            raise ValueError(
                f"two actuators of {self.name!r} fall on one node of the mesh; lower rings or raise divisions"
            )
        return self

    @property
    def mirror_terms(self) -> int:
        """Noll terms by which it deforms M2."""
        return self.terms

    def channels(self, light: Light) -> tuple[str, ...]:
        """Return ring and place in it, as r2a5."""
        return tuple(name for name, *_ in _ringed(self.rings))

    def bending(self) -> Bending:
        """Return statics and modes.

        Raises
        ------
        UserError
            If the method of reduction does not suit the disc.
        """
        try:
            return _bending(self._body(), self.reduction, self.terms)
        except UserError as error:
            raise UserError(f"actuator.{self.name}: {error}") from None

    def put(self, light: Light, states: States, positions: Array) -> None:
        """Add the surface at rest of positions (batch, p) to the figure of M2."""
        self._bend(states, positions @ self.bending().static)

    def own_modes(self) -> OwnModes:
        """Return the modes of the disc on its actuators."""
        found = self.bending()
        return OwnModes(
            tuple(f"{self.name} {hertz:.4g} Hz" for hertz in found.hertz),
            tuple(recoil(float(hertz), self.zeta) for hertz in found.hertz),
            found.drives,
            lambda states, positions: self._bend(states, positions @ found.shapes),
        )

    def _bend(self, states: States, surface: Array) -> None:
        figure = states.deformations[M2]
        assert figure is not None
        figure[: len(surface), : self.terms] += surface * MM_PER_NM

    def _body(self) -> "_Body":
        disc = CircularMirror(
            self.diameter_m,
            self.thickness_m,
            np.inf if self.radius_m is None else self.radius_m / 2,
            Material(self.young_gpa * 1e9, self.poisson, self.density_kg_m3),
            mount_radius=self.diameter_m / 3,
            core=self.divisions,
            rings=self.divisions,
        )
        return _Body(disc, self.rings, self.stiffness_n_um * 1e6)


class _Body(NamedTuple):
    """A disc, rings of actuators, and their stiffness in N/m."""

    disc: CircularMirror
    rings: int
    stiffness: float


def _ringed(rings: int) -> tuple[tuple[str, float, float], ...]:
    """Return actuators by name, with x and y in radii of the disc; the last ring is half a pitch inside."""
    found = [("r0a1", 0.0, 0.0)]
    for ring in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        at = ring / (rings + 0.5) * np.exp(1j * angle)
        found += [(f"r{ring}a{k + 1}", float(one.real), float(one.imag)) for k, one in enumerate(at)]
    return tuple(found)


@prepared(maxsize=4)
def _model(disc: CircularMirror, rings: int, stiffness: float) -> FiniteElementModel:
    """Return the disc on its actuators, which are its interface: nodes of its rear."""
    free = circular_mirror(disc)
    front = free.nodes[free.surface_nodes]
    wanted = 0.5 * disc.diameter * np.array([[x, y] for _, x, y in _ringed(rings)])
    above = front[KDTree(front[:, :2]).query(wanted)[1]]
    places = np.asarray(KDTree(free.nodes).query(above - [0.0, 0.0, disc.thickness])[1], dtype=np.int64)
    return on_springs(replace(free, interfaces=places), (stiffness,) * 3)


@prepared(maxsize=4)
def _bending(body: _Body, reduction: str, terms: int) -> Bending:
    """Return what a disc does, all degrees of freedom at rest and the modes of a reduced model beyond."""
    model = _model(*body)
    if structure(model).rigid.shape[1]:
        raise UserError(
            f"actuators of {body.stiffness * 1e-6:g} N/um are too soft to hold a disc; raise stiffness_n_um."
        )
    pushed = model.inputs[:, 2::3].toarray() * body.stiffness
    surface = model.surface[2::3]
    form_of = reduce(model, reduction)
    form = modal_form(form_of)
    moved = form.inputs[:, 2::3] * body.stiffness / form.squared[:, None]
    fit = _zernike_fit(model, 0.5 * body.disc.diameter, terms)
    at_rest = surface @ elastic_flexibility(structure(model))(pushed)
    return Bending(
        np.ascontiguousarray((fit @ at_rest).T),
        np.sqrt(form.squared) * _HZ,
        moved,
        np.ascontiguousarray((fit @ (form_of.surface[2::3] @ form.modes)).T),
    )


def _zernike_fit(model: FiniteElementModel, radius: float, terms: int) -> Array:
    """Return Noll coefficients per motion of the nodes of the front, (terms, q), by areas."""
    x, y = model.nodes[model.surface_nodes, :2].T / radius
    root = np.sqrt(model.surface_weights)[:, None]
    return np.asarray(np.linalg.pinv(root * annular_zernike(x, y, terms)) * root.T)
