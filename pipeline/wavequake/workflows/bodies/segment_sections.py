"""Sections of studies of segmented telescopes with bodies of mass."""

from typing import Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from wavequake.workflows.bodies.sections import ComparedModelsSection, StructureSection, UncertainSection


class UncertainSupports(UncertainSection):
    """What is not known of the segments' supports, and of bodies: every model that is drawn has others."""

    supports: Literal["alike", "apart"] = Field(
        default="alike", description="off by the same at all segments, or at each by itself"
    )


class SegmentStructureSection(StructureSection):
    """What bodies of mass have in common, and the supports of the segments, on which segment-wind pushes."""

    uncertain: UncertainSupports | None = None


class ComparedSegmentsSection(ComparedModelsSection):
    """Reduced models of elastic segments and bodies that are compared."""

    of: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description='bodies that are reduced, and "segment"; default: all that are elastic',
    )

    @model_serializer(mode="wrap")
    def _all_are_not_named(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        record: dict[str, Any] = handler(self)
        return {key: value for key, value in record.items() if key != "of" or value}


def without_bodies(record: dict[str, Any]) -> dict[str, Any]:
    """Return the record of a study as it was before there were bodies: nothing is said of them."""
    record = {key: value for key, value in record.items() if key not in ("body", "link")}
    uncertain = (record.get("structure") or {}).get("uncertain")
    if uncertain is not None:
        record["structure"] = {
            "uncertain": {key: value for key, value in uncertain.items() if key != "shapes"}
        }
    return record
