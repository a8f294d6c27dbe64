"""Derivatives of light that fills a stop wherever it stands: every ray aimed anew by an own iteration."""

from dataclasses import replace

import numpy as np
import pytest

from wavequake.kernels.device.devices import NUMPY
from wavequake.kernels.trace.sequence import Rays
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.optics.catalog.names import optical_system
from wavequake.optics.derivatives.sensitivity import default_steps, figure_sensitivity, rigid_sensitivity
from wavequake.optics.rays.packing import moving
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import analyse_system, prepare_system, trace_light
from wavequake.workflows.systems.bench import deformable


def prepared_of(system):
    pupil = sunflower(system.pupil.obscuration, 1.0, 60)
    return prepare_system(system, pupil.x, pupil.y, pupil.weight, 11, len(system.fields) - 1)


def at_stop(prepared, rays, light):
    stop = prepared.system.stop + 1
    elements = prepared.sequence.elements[:stop]
    part = replace(prepared.sequence, elements=(*elements[:-1], replace(elements[-1], action="pass")))
    short = replace(
        light, poses=light.poses[:, :stop], deformations=light.deformations[:stop], grids=light.grids[:stop]
    )
    traced = trace_sequence_numpy(part, rays, short, True)
    return np.concatenate([traced.x, traced.y])


def moved_rays(rays, numbers, far, index):
    """Shifted across the light of an infinitely far object, or turned about the object point."""
    flat = np.concatenate([numbers, np.zeros((1, numbers.shape[1]))])
    if far:
        path = rays.path + index * np.sum(rays.direction * flat, axis=0)
        return Rays(rays.position + flat, rays.direction, path)
    direction = rays.direction / rays.direction[2] + flat
    return Rays(rays.position, direction / np.linalg.norm(direction, axis=0), rays.path)


def aimed_anew(prepared, rays, light):
    """Newton's iteration of every ray by itself, to where it met the stop at rest."""
    system = prepared.system
    far = not np.isfinite(system.object_distance)
    target = at_stop(prepared, rays, moving(system, rest_states(system)))
    numbers = np.zeros((2, rays.path.size))
    size = 1e-3 if far else 1e-6
    for _ in range(5):
        met = at_stop(prepared, moved_rays(rays, numbers, far, 1.0), light)
        probes = [
            at_stop(prepared, moved_rays(rays, numbers + size * step[:, None], far, 1.0), light) - met
            for step in np.eye(2)
        ]
        slopes = np.stack(probes, axis=2).transpose(1, 0, 2) / size
        numbers = numbers + np.linalg.solve(slopes, (target - met).T[..., None])[..., 0].T
    return moved_rays(rays, numbers, far, 1.0)


def exact(prepared, states):
    light = moving(prepared.system, states)
    rays, chief = (aimed_anew(prepared, one, light) for one in (prepared.rays, prepared.chief))
    again = replace(prepared, rays=rays, chief=chief)
    return analyse_system(again, *trace_light(again, light, NUMPY))


def compare(prepared, found, element, dof, change, step):
    """Central differences of exact traces against a column, to 2e-5 of the largest of its kind."""
    ends = []
    for sign in (1.0, -1.0):
        states = rest_states(prepared.system)
        change(states, sign * step)
        ends.append(exact(prepared, states))
    group = slice(0, 3) if found.dofs[dof] in ("dx", "dy", "dz") else slice(3, None)
    for name in ("zernike", "los", "centroid"):
        truth = (getattr(ends[0], name) - getattr(ends[1], name))[0] / (2.0 * step)
        values = getattr(found, name)
        scale = np.abs(values[:, group]).max()
        np.testing.assert_allclose(values[element, dof][-len(truth) :], truth, rtol=0, atol=2e-5 * scale)


@pytest.mark.parametrize("name", ["double-gauss", "six-lens", "euv", "gregorian"])
def test_columns_of_surfaces_before_the_stop_are_those_of_rays_aimed_anew(name):
    system = optical_system(name)
    prepared = prepared_of(system)
    found, steps = rigid_sensitivity(prepared, [], NUMPY), default_steps(system)
    for element in {0, max(system.stop - 1, 0), system.stop}:
        for dof in range(5):

            def change(states, size, element=element, dof=dof):
                states.surface_motion[:, element, dof] = size

            step = steps.translation if dof < 3 else steps.rotation
            compare(prepared, found, element, dof, change, step)


def test_columns_of_figures_before_the_stop_are_those_of_rays_aimed_anew():
    system = deformable(optical_system("double-gauss"), {0: 8, 2: 8})
    prepared = prepared_of(system)
    found, steps = figure_sensitivity(prepared, [0, 2], 8, NUMPY), default_steps(system)
    for dof in (1, 3, 6, 7):

        def change(states, size, dof=dof):
            states.deformations[0][:, dof] = size

        compare(prepared, found, 0, dof, change, steps.figure)
