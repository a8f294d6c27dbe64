"""The bundled studies made small that are recorded, see `tests.recorded`."""

from dataclasses import dataclass, field

from tests.workflows.small_disc import DISC

EXPOSED = {
    "model.rings": 2,
    "reduction.reference": "craigb36",
    "reduction.variants": ["krylov36(150)"],
    "imaging.pixels": 24,
    "imaging.pupil_samples": 48,
    "imaging.instants": 5,
    "optics.rays": 200,
    "optics.zernike_terms": 21,
    "time.duration_s": 0.005,
}
SEGMENTS = {
    "disturbance.alignment.instants": 2,
    "disturbance.edge-sensors.instants": 4,
    "disturbance.wind.instants": 4,
    "disturbance.wind-shake.instants": 4,
    "imaging.pixels": 16,
}
FEW_SEGMENTS = SEGMENTS | {"telescope.name": "tmt-18", "imaging.enabled": False}
MIRRORS = {
    "model.rings": 2,
    "reduction.frequencies": 24,
    "imaging.pixels": 12,
    "imaging.pupil_samples": 24,
    "imaging.instants": 3,
    "optics.rays": 200,
    "optics.zernike_terms": 21,
    "time.duration_s": 0.004,
}
GAUSS = {
    "optics.rays": 100,
    "disturbance.vibration.instants": 8,
    "disturbance.all.instants": 8,
}
# A field off the axis, in one color, where a variant needs no more.
ASIDE = GAUSS | {"system.fields_deg": [[0.0, 10.0]], "system.wavelengths_nm": [587.6]}
SHAKEN = {
    "telescope.name": "tmt-18",
    "segments.name": "6",
    "model.divisions": 3,
    "reduction.frequencies": 20,
    "reduction.spot_checks": 1,
    "time.duration_s": 0.05,
    "time.traced": 16,
    "optics.rays_per_segment": 18,
    "optics.zernike_terms": 11,
    "imaging.pixels": 12,
}
CONTROLLED = {
    "model.divisions": 3,
    "model.modes": 60,
    "controller.effort": [0.1],
    "reduction.variants": ["modal10", "craigb18", "rubin15", "krylov27(50)"],
    "reduction.frequencies": 40,
}
TRACED = {"model.rings": 2, "optics.rays": 120, "optics.zernike_terms": 21, "time.duration_s": 0.002}
SHORT = {"time.duration_s": 2.0, "time.step_ms": 20.0}
STRUCTURE = {
    "body.primary.mirror.rings": 2,
    "body.secondary.mirror.rings": 2,
    "body.tube.beams.pieces": 1,
    "reduction.variants": ["guyan", "craigb24"],
    "disturbance.floor.instants": 8,
    "disturbance.floor.share": 1,
    "disturbance.wheel.instants": 8,
    "disturbance.wheel.share": 1,
    "disturbance.gravity.instants": 4,
    "disturbance.all.instants": 8,
    "disturbance.all.share": 1,
    "imaging.pixels": 16,
    "optics.rays": 120,
}
JITTER = {"disturbance.jitter.instants": 4, "disturbance.phasing-and-jitter.instants": 4}
HISTORY = {"disturbance.history.instants": 4, "optics.rays": 400}
LOOPS = HISTORY | {
    "disturbance.history.instants": 20,
    "imaging.pixels": 16,
    "look.traced": 2,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    **DISC,
    "controller.body-perfect.modes": 12,
    "controller.body.modes": 12,
    "controller.rigid.vary": {"latency_frames": [0.5, 2.0]},
    "controller.elastic.vary": {"latency_frames": [0.5, 2.0], "gain": [0.2]},
    "controller.body.vary": {"latency_frames": [0.5, 2.0], "bandwidth_hz": [20.0]},
    "controller.elastic-faint.vary": {"rate_hz": [500.0]},
    "controller.elastic-lqg.vary": {"latency_frames": [1.5]},
}
STEADIED = {
    **{
        f"disturbance.{name}.{key}": value
        for name in ("tremor", "drive", "both")
        for key, value in (("instants", 4), ("duration_s", 0.25))
    },
    "optics.rays": 60,
    "imaging.pixels": 16,
    "controller.integrator.vary": {"bandwidth_hz": [20.0]},
}
RINGING = {
    "disturbance.shaken.instants": 40,
    "disturbance.shaken.duration_s": 0.2,
    "disturbance.shaken.low_hz": 10.0,
    "disturbance.shaken.high_hz": 40.0,
    "optics.rays": 300,
    "imaging.pixels": 16,
    "look.traced": 2,
    "wavefront.zernike_terms": 15,
    "actuator.figure.terms": 15,
    "controller.tilt.vary": {"bandwidth_hz": [15.0]},
    "controller.tilt-lqg.vary": {"latency_frames": [1.0]},
    "controller.tilt-both.vary": {"latency_frames": [0.5]},
    "controller.figure.vary": {"bandwidth_hz": [15.0]},
    "controller.figure-lqg.vary": {"latency_frames": [0.5]},
}


@dataclass(frozen=True)
class Small:
    """A bundled study made small: changed keys, and the number of cases where it is not given by them."""

    study: str
    keys: dict = field(default_factory=dict)
    cases: int | None = None


RECORDED = {
    "controller-mor": Small("controller-mor", CONTROLLED),
    "double-gauss": Small("double-gauss", GAUSS, 8),
    "double-gauss-slopes": Small(
        "double-gauss", ASIDE | {"wavefront.method": "slopes", "wavefront.zernike_terms": 15}, 4
    ),
    "double-gauss-sphere": Small(
        "double-gauss",
        ASIDE
        | {
            "wavefront.reference": "fitted",
            "campaign.sampling": "latin-hypercube",
            "campaign.replicates": 2,
        },
        8,
    ),
    "euv": Small("euv", {"optics.rays": 120}, 6),
    "euv-allowances": Small("euv-allowances", {"optics.rays": 120}, 6),
    "euv-every": Small(
        "euv",
        {
            "optics.rays": 120,
            "disturbance.drift.instants": 8,
            "disturbance.heating.share": 0,
            "store.every": 8,
        },
        3,
    ),
    "jwst-segments": Small(
        "jwst-segments",
        {
            "disturbance.jitter.instants": 4,
            "disturbance.phasing-and-jitter.instants": 4,
            "imaging.pixels": 16,
        },
        3,
    ),
    "jwst-segments-field": Small(
        "jwst-segments",
        JITTER
        | {
            "imaging.enabled": False,
            "optics.field_arcmin": [1.0, 0.5],
            "wavefront.method": "slopes",
            "wavefront.basis": "circular",
        },
        6,
    ),
    "lens-experiment": Small("lens-experiment", SHORT, 2),
    "lens-firmware": Small("lens-firmware", SHORT, 2),
    "lens-passive": Small("lens-passive", {"passive.iterations": 3}, 2),
    "mirror-exposure": Small("mirror-exposure", EXPOSED),
    "mirror-exposure-coherent": Small(
        "mirror-exposure", EXPOSED | {"object.grating": 2.0, "object.light": "coherent"}, 1
    ),
    "mirror-exposure-incoherent": Small("mirror-exposure", EXPOSED | {"object.chart": [0.5, 0.25]}, 1),
    "mirror-exposure-partial": Small(
        "mirror-exposure",
        EXPOSED | {"object.double_slit": [0.75, 2.25], "object.light": "partial", "object.sigma": 0.4},
        1,
    ),
    "mirror-mor": Small("mirror-mor", MIRRORS),
    "mirror-trace": Small("mirror-trace", TRACED),
    "mirror-trace-residual": Small(
        "mirror-trace", TRACED | {"model.shapes": ["circular"], "optics.residual_limit": 0.0}
    ),
    "image-stabilizer": Small("image-stabilizer", STEADIED, 3),
    "structure-loop": Small("structure-loop", RINGING, 2),
    "telescope-structure": Small("telescope-structure", STRUCTURE, 12),
    "tip-tilt-vibration": Small(
        "tip-tilt-vibration", {"simulated.duration_s": 4.0, "simulated.settling_s": 1.0}, 6
    ),
    "tmt-ao": Small("tmt-ao", LOOPS, 3),
    "tmt-exposure": Small("tmt-exposure", HISTORY | {"imaging.pixels": 16, "wavefront.zernike_terms": 28}, 2),
    "tmt-exposure-slit": Small(
        "tmt-exposure",
        HISTORY
        | {
            "imaging.pixels": 16,
            "wavefront.zernike_terms": 28,
            "object.slit": 1.0,
            "object.light": "partial",
            "object.sigma": 0.4,
        },
        1,
    ),
    "tmt-m1-control": Small(
        "tmt-m1-control", {"mirror.telescope": "tmt-18", "control.bandwidths_hz": [0.3, 2.0]}, 2
    ),
    "tmt-million": Small("tmt-million", {}, 40),
    "tmt-million-series": Small(
        "tmt-million", {"store.reduce": "none", "optics.modal_tolerance_nm": 1e-4}, 3
    ),
    "tmt-rare": Small("tmt-rare", {"telescope.name": "tmt-18", "rare.limit": 100.0}, 6),
    "tmt-segment-mor": Small("tmt-segment-mor", SHAKEN),
    "tmt-segments": Small("tmt-segments", SEGMENTS, 8),
    "tmt-segments-figures": Small(
        "tmt-segments",
        SEGMENTS
        | {
            "disturbance.alignment.figure_nm": {"4": 20.0, "7": 10.0},
            "disturbance.alignment.piston_distribution": "uniform",
            "optics.rays_per_segment": 36,
        },
        1,
    ),
    "tmt-segments-sobol": Small(
        "tmt-segments",
        FEW_SEGMENTS
        | {
            "disturbance.edge-sensors.share": 0,
            "disturbance.wind.share": 0,
            "campaign.sampling": "sobol",
            "store.reduce": "summary",
        },
        16,
    ),
    "tmt-segments-sphere": Small(
        "tmt-segments", FEW_SEGMENTS | {"wavefront.reference": "fitted", "store.every": 2}, 4
    ),
    "tmt18-history": Small("tmt18-history", HISTORY | {"imaging.pixels": 16}, 3),
}
