"""What study files of disturbed optics have in common: of segmented telescopes, and of any other system."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from wavequake.campaign.measures import Measure, stored
from wavequake.campaign.schema import Section, Study, require_own_names
from wavequake.chain.images.camera import DetectorSection
from wavequake.chain.images.extended import ObjectSection
from wavequake.chain.sampling import SampledCampaignSection, replicate_labels, slots
from wavequake.chain.uncertain import shared_models
from wavequake.mechanics.disturbances.registry import with_own_axes
from wavequake.optics.polynomials.zernike import MOST_TERMS
from wavequake.workflows.asked_sections import AllowSection, BudgetSection
from wavequake.workflows.bodies.sections import BodySection, ComparedModelsSection, LinkSection
from wavequake.workflows.mirrors.study import FULL

_BASES = {
    "annular": "annular Noll Zernike coefficients",
    "circular": "equivalent circular Noll Zernike coefficients (Störkle 2018, Eq. 3.53)",
}
_SPHERES = {"chief": "the chief ray", "fitted": "the best-fit sphere"}


class WavefrontSection(Section):
    """What is fitted to wavefronts, and to what of them."""

    zernike_terms: int = Field(
        default=28,
        ge=4,
        le=MOST_TERMS,
        description="by Noll index; annular where the pupil is obscured; needs 2 to 5 rays per term",
    )
    method: Literal["opd", "slopes"] = Field(
        default="opd",
        description="coefficients and line of sight from path lengths, or from ray slopes alone "
        "(Störkle 2018, Eq. 4.20): these see tilts and figures, but no piston of a segment or of the pupil",
    )
    basis: Literal["annular", "circular"] = Field(
        default="annular",
        description="of the stored coefficients where the pupil is obscured; circular ones are equivalent "
        "(Eq. 3.53), but the sum of their squares is not the rms over the annulus, which stays that of the "
        "annular ones",
    )
    reference: Literal["chief", "fitted"] = Field(
        default="chief",
        description="center of the reference sphere in the image: where the (virtual) chief ray arrives, or "
        "that of the sphere that fits the wavefront best (section 3.3.3; needs method opd)",
    )

    @model_validator(mode="after")
    def _slopes_have_no_sphere(self) -> "WavefrontSection":
        if self.method == "slopes" and self.reference == "fitted":
            raise ValueError("reference = 'fitted' needs path lengths; choose method = 'opd' for it")
        return self

    @property
    def plain(self) -> bool:
        """Whether it is from path lengths about the chief ray."""
        return self.method == "opd" and self.reference == "chief"


class DisturbedStudy(Study):
    """A study whose cases are realizations of disturbances of optics."""

    campaign: SampledCampaignSection = SampledCampaignSection()
    body: tuple[BodySection, ...] = Field(default=(), strict=False)
    link: tuple[LinkSection, ...] = Field(default=(), strict=False)
    wavefront: WavefrontSection = WavefrontSection()
    object: ObjectSection | None = None
    detector: DetectorSection | None = None
    allow: AllowSection | None = None
    budget: BudgetSection | None = None
    reduction: ComparedModelsSection | None = None

    asked: ClassVar[frozenset[str]] = frozenset({"allow", "budget"})
    if TYPE_CHECKING:  # each kind has its own
        disturbance: tuple[Any, ...]
        optics: Any
        structure: Any

    @field_validator("disturbance", check_fields=False)
    @classmethod
    def _populations_are_sound(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        require_own_names("disturbance", value)
        names = [entry.name for entry in value]
        for entry in value:
            chosen = getattr(entry, "of", ())
            twice = next((name for name in chosen if chosen.count(name) > 1), None)
            if twice is not None:
                raise ValueError(f"{entry.name!r} names {twice!r} twice; name it once")
            for part in chosen if entry.model == "combine" else ():
                if part not in names or part == entry.name:
                    raise ValueError(
                        f"{entry.name!r} combines {part!r}, which is not another disturbance of this study"
                    )
        if not any(entry.share for entry in value):
            raise ValueError("every disturbance has share 0, so there is nothing to run")
        return with_own_axes(value)

    @model_validator(mode="after")
    def _modal_light_is_of_path_lengths(self) -> "DisturbedStudy":
        if self.optics.light == "modal" and not self.wavefront.plain:
            raise ValueError(
                "optics.light = 'modal' needs wavefront.method = 'opd' and wavefront.reference = 'chief'"
            )
        return self

    @property
    def compared(self) -> tuple[str, ...]:
        """Models of what is elastic that are compared, the full one first; a draw is a case with each."""
        return (FULL, *self.reduction.variants) if self.reduction is not None else (FULL,)

    @property
    def fewest_instants(self) -> int:
        """Number of instants of the shortest case."""
        return int(min(entry.instants for entry in self.disturbance if entry.share))


def wavefront_measures(
    wavefront: WavefrontSection, over: tuple[str, ...], rays: str, *, on_sky: bool, attrs: Mapping[str, str]
) -> Iterator[Measure]:
    """Yield the measures of wavefronts over instants and places, ``("time", ...)``.

    `rays` says which count; what is of the image is `on_sky` in mas, else in mm and um. `attrs` say over what
    the polynomials are orthogonal.
    """
    unit, end, places = ("mas", "", over[1:]) if on_sky else ("mm", "_mm", over[1:])
    words = "time of the instant; NaN beyond the population's instants"
    yield stored("time_s", "s", words, ("time",), coordinate=True)
    words = "wavefront error rms of the fitted Zernikes j >= 4 (piston and tilt removed)"
    yield stored("wfe_rms", "nm", words, over)
    sphere = "" if on_sky else f", tilt about the image point of {_SPHERES[wavefront.reference]}"
    words = f"wavefront error rms over the rays {rays}, piston removed{sphere}"
    yield stored("wfe_rms_raw", "nm", words, over)
    words = f"peak to valley of the wavefront over the rays {rays} about their best-fit plane"
    yield stored("wfe_pv", "nm", words, over)
    slopes = wavefront.method == "slopes"
    words = f"{_BASES[wavefront.basis]}, total"
    words += ", from the slopes of the rays (Störkle 2018, Eq. 4.20), which do not know piston" * slopes
    if wavefront.reference == "fitted":
        words += ", about the best-fit sphere's image point (Störkle 2018, section 3.3.3)"
    yield stored("zernike", "nm", words, (*over, "noll"), attrs=attrs, unknown=int(slopes))
    words = "line of sight of the best-fit plane relative to rest "
    words += "(Störkle 2018, Eq. 3.39, annular tilt / sqrt(1 + eps^2))"
    yield stored(f"los{end}", unit, words, (*over, "axis"))
    words = "geometric centroid of the rays, relative to rest"
    yield stored(f"centroid{end}", unit, words, (*over, "axis"))
    words = "rms distance of the rays' image points from their centroid"
    yield stored("spot_rms", unit if on_sky else "um", words, over)
    yield stored("strehl", "1", "Strehl ratio in the direction of the best-fit plane", over)
    words = "share of instants with a peak to valley of at most lambda/4 (Störkle 2018, Eq. 3.54)"
    yield stored("rayleigh", "1", words, places)
    words = (
        f"share of instants with an rms over the rays {rays}, piston and tilt removed, of at most lambda/14 "
    )
    yield stored("marechal", "1", words + "(Störkle 2018, Eq. 3.55)", places)
    yield stored("vignetted", "1", "largest number of rays at an instant that openings stop", places)


def modal_measures(errors: Mapping[str, str], bound: str) -> Iterator[Measure]:
    """Yield what tells of the modal model's error: units of measures by name, and what its `bound` is of."""
    words = (
        "0: numbers of the modal model; 1: of the modal model, and traced in full to measure its error; "
        "2: of full traces, as the motion is beyond the model's range"
    )
    yield stored("traced", "1", words, dtype="int8")
    words = f"bound of the rms over the rays of the second order that the modal model leaves out{bound}"
    yield stored("modal_bound", "nm", words)
    for name, unit in errors.items():
        words = (
            f"largest error of the {name} of the modal model in the case, where it was traced to measure it"
        )
        yield stored(f"modal_error_{name}", unit, words)


def case_labels(study: DisturbedStudy, cases: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return the labels of cases: disturbance, realization and seed."""
    which, places = slots([entry.share for entry in study.disturbance], cases)
    realizations, model = np.divmod(places, len(study.compared))
    models = {"reduction": np.array(study.compared, dtype=object)[model]}
    return {
        "disturbance": np.array([entry.name for entry in study.disturbance], dtype=object)[which],
        **(models if study.reduction is not None else {}),
        "realization": realizations,
        "seed": np.full(len(cases), study.study.seed, dtype=np.int64),
        **replicate_labels(study.campaign, realizations),
        **shared_models(study.structure.uncertain if study.structure else None, realizations),
    }
