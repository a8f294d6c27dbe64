"""Parts of study files in a line each."""

import json


def value(found):
    """Return a value as TOML has it."""
    if isinstance(found, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {value(one)}" for key, one in found.items()) + " }"
    if isinstance(found, (list, tuple)):
        return "[" + ", ".join(map(value, found)) + "]"
    return json.dumps(found)


def part(section, **keys):
    """Return an entry of a section that has several, such as a sensor."""
    return f"[[{section}]]\n" + "".join(f"{key} = {value(one)}\n" for key, one in keys.items())


def controller(name, model, sensor="", actuator="", **keys):
    """Return a controller; without a sensor it has none."""
    joined = {"sensor": sensor, "actuator": actuator} if sensor else {}
    return part("controller", name=name, model=model, **joined, **keys)


def force(at, hertz, newtons, **keys):
    """Return a force at a frequency on a node of a body."""
    lines = [{"frequency_hz": hertz, "force_n": newtons}]
    return part("disturbance", model="body-force", at=[at], **keys, lines=lines)


def steered(of, dofs, rate_hz, **keys):
    """Return a sensor of the line of sight, a stage that moves an element, and no controller yet but off."""
    sensor = part("sensor", name="sight", model="line-of-sight", rate_hz=rate_hz)
    stage = part("actuator", name="stage", model="optic", of=of, dofs=dofs, **keys)
    return sensor + stage + controller("off", "off")
