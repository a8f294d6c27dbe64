"""The workflow "lens-passive": springs and inertias with which the lens bench moves the image least.

A case is one start of the search, which has many local minima (Störkle 2018, Eq. 5.4).
"""

from collections.abc import Iterator
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.campaign.measured import Block, CaseTable, one_by_one, study_kind
from wavequake.campaign.measures import Axis, Measure, stored
from wavequake.campaign.schema import CampaignSection, Section, StoreSection, Study
from wavequake.campaign.stopwatch import Stopwatch
from wavequake.control.bench import LENSES, Bench, bench_modes, fitted_bench
from wavequake.control.passive import modal_amplitudes, optimize
from wavequake.control.plant import swing
from wavequake.mechanics.disturbances.motion import generator

Array = NDArray[np.float64]

PARAMETERS = {
    "lens_springs": LENSES,
    "ring_springs": LENSES,
    "couplings": 5,
    "lens_kg": LENSES,
    "ring_kg": LENSES,
}
MODES = 13


class PassiveSection(Section):
    """What the search may change, and by how much."""

    springs: bool = Field(default=True, description="whether stiffnesses of springs and couplings may change")
    inertias: bool = Field(default=True, description="whether masses of lenses and rings may change")
    factor: float = Field(default=1.5, gt=1, le=10, description="largest ratio to the present values")
    iterations: int = Field(
        default=200, ge=1, le=10_000, description="of the search from each start, at most"
    )

    @model_validator(mode="after")
    def _something_changes(self) -> Self:
        if not (self.springs or self.inertias):
            raise ValueError("neither springs nor inertias may change")
        return self


class PassiveCampaignSection(CampaignSection):
    """How much of the study to run, and on which device; not part of its identity."""

    cases: int = Field(default=40, ge=1, le=100_000_000, description="starts of the search")


class PassiveStoreSection(StoreSection):
    """Where the results go; nothing is stored over time."""

    chunk_cases: int = Field(default=4, ge=1, le=100_000, description="K: cases per task and per shard")


class PassiveStudy(Study):
    """A validated study file of ``lens-passive``: the bench with six lenses, no controller."""

    passive: PassiveSection = PassiveSection()
    campaign: PassiveCampaignSection = PassiveCampaignSection()
    store: PassiveStoreSection = PassiveStoreSection()


def start_of(study: PassiveStudy, case: int) -> Array:
    """Return where a case starts, as shares of the range; case 0 starts at the present values."""
    section = study.passive
    sizes = [
        size
        for name, size in PARAMETERS.items()
        if (section.inertias if name.endswith("kg") else section.springs)
    ]
    return generator(study.study.seed, "lens-passive", case).uniform(-1, 1, sum(sizes)) * (case > 0)


def compute(study: PassiveStudy, table: CaseTable, device: str, clock: Stopwatch) -> Iterator[Block]:
    """Search from the starts of cases, and swing the benches that are found."""
    section, present = study.passive, fitted_bench(active=False)

    def of_case(case: int) -> dict[str, Array]:
        found = optimize(
            present,
            springs=section.springs,
            inertias=section.inertias,
            factor=section.factor,
            start=start_of(study, case),
            iterations=section.iterations,
        )
        return _row(found.bench, present)

    return one_by_one(table["case"], of_case)


def _row(bench: Bench, present: Bench) -> dict[str, Array]:
    # Two benches beside each other, always: the sums' bits depend on nothing else.
    image = swing([bench, present], np.ones(2), duration=3.0).image
    return {
        "amplitude_sum": np.asarray(1e3 * modal_amplitudes(bench).sum()),
        "peak_to_peak_mm": np.asarray(1e3 * np.ptp(image[0])),
        "peak_to_peak": np.asarray(100 * np.ptp(image[0]) / np.ptp(image[1])),
        "frequency": bench_modes(bench).omega,
        "mode_amplitude": 1e3 * modal_amplitudes(bench),
        **{name: getattr(bench, name) for name in PARAMETERS},
    }


def axes(study: PassiveStudy) -> dict[str, Axis]:
    """Return the dimensions of the measures."""
    return {"lens": Axis(np.arange(1, LENSES + 1), "lens"), "gap": Axis(LENSES - 1), "mode": Axis(MODES)}


def measures(study: PassiveStudy) -> Iterator[Measure]:
    """Yield the measures of a bench that was found."""
    lens = ("lens",)
    yield stored("amplitude_sum", "mm", "sum of the modes' amplitudes in the image: what is minimized")
    yield stored("peak_to_peak_mm", "mm", "range of the image displacement after a blow")
    yield stored("peak_to_peak", "%", "the same, present bench = 100")
    yield stored("frequency", "rad/s", "frequencies of the modes", ("mode",))
    yield stored("mode_amplitude", "mm", "amplitudes of the modes in the image", ("mode",))
    yield stored("lens_springs", "N/m", "springs between lens and ring", lens)
    yield stored("ring_springs", "N/m", "springs between ring and housing", lens)
    yield stored("couplings", "N/m", "springs between neighboring rings", ("gap",))
    yield stored("lens_kg", "kg", "inertia of each lens over its squared pendulum length", lens)
    yield stored("ring_kg", "kg", "the same of each ring", lens)


def cases(study: PassiveStudy, ids: NDArray[np.int64]) -> CaseTable:
    """Return the numbers of the starts, and the seed."""
    return {"realization": ids, "seed": np.full(len(ids), study.study.seed)}


KIND = study_kind("lens-passive", PassiveStudy, cases=cases, compute=compute, measures=measures, axes=axes)
