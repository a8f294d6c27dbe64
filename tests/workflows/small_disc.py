"""The disc on actuators of ``tmt-ao``, small, which keeps both modes of every pair."""

DISC = {
    "actuator.mirror.rings": 2,
    "actuator.mirror.stiffness_n_um": 5000.0,
    "actuator.mirror.thickness_m": 0.3,
    "actuator.mirror.divisions": 4,
    "actuator.mirror.reduction": "modal11",
    "actuator.mirror.terms": 15,
}
