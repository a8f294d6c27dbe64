"""Reduced models that stand beside the full one as cases, and how far they are from it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from wavequake.campaign.contract import Fixed
from wavequake.campaign.measures import Measure, stored
from wavequake.campaign.schema import Section, each_once
from wavequake.mechanics.model import FiniteElementModel, ReducedModel
from wavequake.prepared import one_thread
from wavequake.reduction.intermediate import Intermediate
from wavequake.reduction.metrics import eps_mor, full_receptance, receptance
from wavequake.reduction.names import parse
from wavequake.reduction.two_stage import covers, reduce_variants, reference
from wavequake.workflows.mirrors.model_store import digest, kept_arrays
from wavequake.workflows.mirrors.study import FULL, ReductionSection, canonical

Array = NDArray[np.float64]

ERRORS = {
    "model_error_wfe": ("nm", "wavefront (Zernikes j >= 4), rms over instants"),
    "model_error_los": ("", "line of sight, rms over instants"),
    "model_error": (
        "1",
        "the larger one of line of sight and wavefront, in parts of what the case does with full models",
    ),
    "model_error_image": ("1", "exposure, L2 norm relative to that of the full model"),
}
"""Of what reduced models are judged by: unit, that of the line of sight left open, and words."""


class ComparedSection(Section):
    """Reduced models that are compared: every draw is a case with each of them."""

    variants: tuple[str, ...] = Field(min_length=1, strict=False, description="e.g. 'craigb36'")
    largest: float = Field(
        default=0.01,
        gt=0,
        description="when a model is good enough: error of line of sight and wavefront, rms, in parts of "
        "what the disturbance does with the full model",
    )

    @field_validator("variants")
    @classmethod
    def _variants_are_canonical(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        names = tuple(canonical(name) for name in value)
        if FULL in names:
            raise ValueError("the full model is compared anyway; leave 'full' out")
        return each_once(names)


def variant_labels(
    rows: Sequence[tuple[str, str]], methods: Sequence[str], seed: int
) -> dict[str, NDArray[Any]]:
    """Return the labels of cases that are variants of models: model, variant, its method and the seed."""
    return {
        "model": np.array([model for model, _ in rows], dtype=object),
        "variant": np.array([variant for _, variant in rows], dtype=object),
        "method": np.array(methods, dtype=object),
        "seed": np.full(len(rows), seed, dtype=np.int64),
    }


def model_errors(
    bent: Array,
    away: Array,
    sizes: tuple[Array, Array],
    numbers: Mapping[str, Array],
    full: Mapping[str, Array],
) -> dict[str, Array]:
    """Return the `ERRORS` of a case.

    Parameters
    ----------
    bent, away : ndarray, shape (time, ..., k)
        Differences to the full model: Noll coefficients from j = 4 on, and line of sight.
    sizes : tuple of two ndarray, shape (...)
        What both do with the full model, rms over the instants.
    numbers, full : mapping of str to ndarray
        With ``exposure`` (..., y, x), if there is one.
    """
    errors = rms_of(bent), rms_of(away)
    parts = [
        np.divide(one, size, out=np.zeros_like(one), where=size > 0.0)
        for one, size in zip(errors, sizes, strict=True)
    ]
    found = {
        "model_error_wfe": errors[0],
        "model_error_los": errors[1],
        "model_error": np.maximum(*parts),
    }
    if "exposure" in numbers:
        apart = np.linalg.norm(numbers["exposure"] - full["exposure"], axis=(-2, -1))
        found["model_error_image"] = apart / np.linalg.norm(full["exposure"], axis=(-2, -1))
    return found


def rms_of(values: Array) -> Array:
    """Return the rms over instants (first axis) of vectors (last axis)."""
    return np.asarray(np.sqrt(np.mean(np.sum(values**2, axis=-1), axis=0)))


def variant_measures() -> Iterator[Measure]:
    """Yield what stores of variants of a model hold of each: its size, and what images are measured by."""
    yield stored("order", "1", "number of coordinates of the variant")
    yield stored("pseudo_frequency_max", "Hz", "largest eigenfrequency of the reduced model")
    words = "lambda/D in the image: wavelength times focal length over diameter"
    yield stored("resolution_mm", "mm", words)


def reduction_measures(place: str) -> Iterator[Measure]:
    """Yield what stores hold of variants beside their reference: receptance at a `place`, image, errors."""
    yield from variant_measures()
    yield stored("reduce_seconds", "s", "time of the reduction", measured=True)
    spectrum = ("frequency",)
    yield stored("frf_mech", "m/N", f"Frobenius norm of the receptance at the {place}", spectrum)
    yield stored("eps_mech", "1", "relative error of the receptance (Störkle 2018, Eq. 2.10)", spectrum)
    words = "distance from the reference's line of sight"
    yield stored("los_error", "mm", words, ("excitation", "time"))
    words = "mean of the instants' images; 1 = peak of the perfect one"
    yield stored("exposure", "1", words, ("excitation", "y", "x"))
    yield stored("image_error", "1", "L2 norm of the difference of unit-energy exposures", ("excitation",))


def image_error(images: Array, reference: Array) -> Array:
    """Return the L2 norms of the differences of unit-energy images (excitation, y, x), (excitation,)."""
    one, two = (part / part.sum(axis=(1, 2), keepdims=True) for part in (images, reference))
    return np.asarray(np.sqrt(np.sum((one - two) ** 2, axis=(1, 2))))


def wavefront_rms(aberrations: Array) -> Array:
    """Return the rms of the Noll terms j >= 4 of (..., 2 + J): the root of the sum of their squares."""
    return np.asarray(np.sqrt(np.sum(aberrations[..., 5:] ** 2, axis=-1)))


def reduced_model(stage: Intermediate, full: Callable[[], FiniteElementModel], name: str) -> ReducedModel:
    """Return a model by its name: reduced, or "full", the intermediate one.

    `full` builds the finite-element model, for variants that the intermediate one does not cover.
    """
    if name == FULL:
        return reference(stage)
    whole = None if covers(stage, parse(name)) else full()
    return reduce_variants(stage, [name], whole)[0]


def checked_model(
    section: ReductionSection, lowest: float, body: Callable[[], Any], record: Mapping[str, Any]
) -> tuple[Array, Array]:
    """Compare an intermediate model with the full one where its basis was not built; kept on disk.

    Parameters
    ----------
    section : ReductionSection
        Says how often, and up to which frequency.
    lowest : float
        Of the frequencies, Hz.
    body : callable
        Returns what has the intermediate model as ``stage``, and builds the other one by ``full``.
    record : mapping
        What determines the intermediate model.

    Returns
    -------
    frequencies, errors : ndarray, shape (checks,)
        Hz, and the relative error of the transfer matrix (Störkle 2018, Eq. 2.10).
    """
    # Irrational parts of the band: no expansion point of the basis lies there.
    parts = np.modf((np.arange(section.spot_checks) + 1) * (np.sqrt(5.0) - 1) / 2)[0]
    frequencies = np.sort(lowest + parts * (section.last_hz - lowest))
    if not len(frequencies):
        return frequencies, frequencies.copy()

    @one_thread()
    def checked() -> dict[str, Array]:
        one = body()
        truth = full_receptance(one.full(), frequencies)
        return {"errors": eps_mor(truth, receptance(reference(one.stage), frequencies))}

    return frequencies, kept_arrays(digest({"check": frequencies.tolist(), **record}), checked)["errors"]


def stage_words(stage: Intermediate, frequencies: Array, errors: Array) -> str:
    """Say how large a model is, and how well its intermediate one stands for it."""
    at = ", ".join(f"{one:.0f}" for one in frequencies)
    worst = f", at most {errors.max():.1e} off the full model at {at} Hz" if len(errors) else ""
    return f"{stage.full_order} degrees of freedom, intermediate {stage.order}{worst}"


def checked_models(names: Sequence[str], checks: Sequence[tuple[Array, Array]]) -> dict[str, Fixed]:
    """Return what stores hold of intermediate models: frequencies and errors of the check of each."""
    words = {"units": "1", "long_name": "error of the intermediate model against the full one (Eq. 2.10)"}
    at = {"units": "Hz", "long_name": "frequency of the check"}
    return {
        "checked_model": (("checked_model",), np.array(names, dtype=object), {"long_name": "model"}),
        "spot_frequency": (("check",), checks[0][0], at),
        "spot_error": (("checked_model", "check"), np.array([errors for _, errors in checks]), words),
    }
