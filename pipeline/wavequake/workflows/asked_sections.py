"""Sections that say what `wavequake allow` and `wavequake budget` are asked; no case depends on them."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from wavequake.campaign.schema import Section, require_own_names

STATIC, RMS = "static", "rms"


class AllowedSpectrumSection(Section):
    """The shape of a spectrum: straight between its points, zero beyond them, of any size."""

    frequency_hz: tuple[Annotated[float, Field(ge=1e-9, le=1e9)], ...] = Field(min_length=2, strict=False)
    psd: tuple[Annotated[float, Field(ge=0, le=1e100)], ...] = Field(
        min_length=2, strict=False, description="power spectral density at these frequencies; scale alike all"
    )

    @model_validator(mode="after")
    def _is_a_spectrum(self) -> "AllowedSpectrumSection":
        if len(self.frequency_hz) != len(self.psd):
            raise ValueError(
                f"frequency_hz has {len(self.frequency_hz)} entries and psd {len(self.psd)}; give as many"
            )
        if any(high <= low for low, high in zip(self.frequency_hz, self.frequency_hz[1:], strict=False)):
            raise ValueError("frequency_hz must increase")
        if max(self.psd) < 1e-100:
            raise ValueError("psd is zero everywhere; a spectrum has power somewhere")
        return self


class AllowSection(Section):
    """What `wavequake allow` limits, and how it shares it out."""

    measure: str | None = Field(
        default=None, description="an upper quantile, as wfe_change.p95 (systems) or wfe_rms.p95 (segments)"
    )
    limit: str = Field(description="with its unit, as '60 nm'")
    by: Literal["shares", "cost", "factor"] = Field(
        default="shares", description="equal shares, shares by cost, or what the study has, times a factor"
    )
    cost: dict[str, Annotated[float, Field(ge=1e-12, le=1e12)]] = Field(
        default={},
        description='what it costs to halve a motion, by element, axis, or both ("M1", "rx", "M1 rx", '
        '"M* rx"); all others 1',
    )
    kind: dict[str, str] = Field(
        default={},
        description="how a motion moves during a case, named as in cost: static, rms (anew at every instant) "
        "or a spectrum of [allow.spectrum]; all others static",
    )
    spectrum: dict[str, AllowedSpectrumSection] = Field(
        default={}, description="shapes of spectra by name: frequency_hz and psd"
    )

    @model_validator(mode="after")
    def _kinds_are_known(self) -> "AllowSection":
        taken = next((name for name in self.spectrum if name in (STATIC, RMS)), None)
        if taken is not None:
            raise ValueError(f"a spectrum cannot be called {taken!r}, which is a kind of its own")
        known = (STATIC, RMS, *self.spectrum)
        for name, kind in self.kind.items():
            if kind not in known:
                raise ValueError(f"kind of {name!r}: there is no {kind!r}; choose one of {', '.join(known)}")
        return self


class BudgetGroupSection(Section):
    """A branch of the budget's tree."""

    name: str = Field(min_length=1, description="of the branch, by which other groups may list it")
    of: tuple[str, ...] = Field(
        min_length=1,
        strict=False,
        description="groups; or disturbances, elements and rings, patterns such as 'M*' included",
    )
    allocation: dict[str, str] = Field(
        default={}, description='what it may be, by quantity: { wfe_rms = "30 nm", los = "2 mas" }'
    )


class BudgetSection(Section):
    """The tree of `wavequake budget`: who may contribute how much."""

    allocation: dict[str, str] = Field(default={}, description="of the whole, at rest included")
    group: tuple[BudgetGroupSection, ...] = Field(default=(), strict=False)

    @model_validator(mode="after")
    def _is_a_tree(self) -> "BudgetSection":
        parents: dict[str, str] = {}
        names = [group.name for group in self.group]
        require_own_names("group", self.group)
        for group in self.group:
            inner = [name for name in group.of if name in names]
            if inner and len(inner) < len(group.of):
                other = next(name for name in group.of if name not in names)
                raise ValueError(
                    f"{group.name!r} is of the group {inner[0]!r} and of {other!r}, which is none; make a "
                    f"group of {other!r}, too"
                )
            for name in inner:
                if name in parents:
                    raise ValueError(
                        f"{name!r} is in {parents[name]!r} and in {group.name!r}; a group has one place"
                    )
                parents[name] = group.name
        for name in names:
            above, steps = name, 0
            while above in parents:
                above, steps = parents[above], steps + 1
                if steps > len(names):
                    raise ValueError(f"{name!r} contains itself; leave it out of what it is made of")
        return self
