"""A small study of every kind: the table that the tests of the contract and of pages go through."""

import small_mirrors
import small_segments
import small_telescope
from small_system import PARABOLA, hum
from study_text import controller, part
from tests.recorded import RECORDED

from wavequake.workflows.study import load_study

SYSTEM = "\n".join(
    [
        PARABOLA,
        "[optics]\nrays = 40\n[wavefront]\nzernike_terms = 6\n",
        hum("image", 7, dy_um=7.0, rx_urad=5.0),
        part("disturbance", name="sight", model="line-of-sight", rms_mas=50.0, instants=3),
    ]
)
MIRROR = {**small_mirrors.TRACE, "time.duration_s": 0.002}
MOR = {**small_mirrors.MOR, "time.duration_s": 0.002, "reduction.variants": ["craigb18"]}
EXPOSURE = {
    "model.rings": 2,
    "reduction.variants": ["craigb18"],
    "imaging.pixels": 16,
    "imaging.pupil_samples": 32,
    "imaging.instants": 3,
    "imaging.scale": 0.003,
    "optics.rays": 120,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.002,
}
TELESCOPE = {
    "imaging.pixels": 16,
    "optics.rays_per_segment": 6,
    "wavefront.zernike_terms": 6,
    "disturbance.mount.instants": 4,
}
EXPOSED = small_telescope.STUDY.replace("segment-disturbance", "telescope-exposure")
LOOPS = {
    "optics.rays": 300,
    "wavefront.zernike_terms": 11,
    "actuator.figure.terms": 11,
    "actuator.mirror.rings": 2,
    "actuator.mirror.stiffness_n_um": 5000.0,
    "actuator.mirror.thickness_m": 0.3,
    "actuator.mirror.divisions": 4,
    "actuator.mirror.reduction": "modal11",
    "actuator.mirror.terms": 11,
    "controller.body-perfect.modes": 10,
    "controller.body.modes": 10,
    "controller.body.vary": {"latency_frames": [0.5], "bandwidth_hz": [60.0]},
    "disturbance.history.instants": 20,
    "imaging.pixels": 16,
    "look.traced": 2,
    "controller.rigid.vary": {"latency_frames": [0.5]},
    "controller.elastic.vary": {"latency_frames": [0.5]},
    "controller.elastic-faint.vary": {},
    "controller.elastic-lqg.vary": {},
}
LENS = {"time.duration_s": 2.0, "time.step_ms": 20.0, "bench.springs": ["initial"]}
SEGMENTS = {"segments.disturbed": ["one"], "reduction.variants": ["modal12"], "excitation.sine.name": "hum"}
STEERED = "\n".join(
    [
        SYSTEM.replace("system-disturbance", "system-loop"),
        part("sensor", name="image", model="line-of-sight", rate_hz=500.0),
        part("actuator", name="steer", model="optic", of="mirror", dofs=["rx", "ry"]),
        controller("off", "off"),
        controller("loop", "integrator", "image", "steer"),
    ]
)
# Study, changed keys, cases.
SMALL = {
    "system-disturbance": (SYSTEM, {}, 5),
    "system-loop": (STEERED, {"disturbance.hum.duration_s": 0.5, "disturbance.sight.duration_s": 0.5}, 5),
    "segment-disturbance": (small_telescope.STUDY, {"imaging.enabled": False}, 7),
    "telescope-exposure": (EXPOSED, TELESCOPE, 3),
    "telescope-loop": ("tmt-ao", LOOPS, 3),
    "lens-experiment": ("lens-experiment", LENS, 3),
    "mirror-trace": ("mirror-trace", MIRROR, None),
    "mirror-mor": ("mirror-mor", MOR, None),
    "mirror-exposure": ("mirror-exposure", EXPOSURE, None),
    "segment-mor": (small_segments.STUDY, SEGMENTS, None),
}
# The same of kinds that store nothing over time.
TIMELESS = {
    "lens-passive": ("lens-passive", {"passive.iterations": 3}, 2),
    "controller-mor": (
        "controller-mor",
        RECORDED["controller-mor"].keys | {"reduction.variants": ["modal10", "craigb18"]},
        None,
    ),
    "tip-tilt-vibration": ("tip-tilt-vibration", RECORDED["tip-tilt-vibration"].keys, 6),
    "segment-control": (
        "tmt-m1-control",
        {"mirror.telescope": "tmt-18", "control.bandwidths_hz": [0.5, 1.0]},
        2,
    ),
}
KINDS = SMALL | TIMELESS


def small_study(name, folder):
    """Load the study of a kind, by way of a file in `folder` if it is written here."""
    text, keys, cases = KINDS[name]
    if "\n" in text:
        path = folder / f"{name}.toml"
        path.write_text(text)
        text = path
    return load_study(text, {**keys, **({"campaign.cases": cases} if cases else {})})
