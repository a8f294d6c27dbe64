"""Trace rays through any sequence of surfaces, every instant of a batch in one launch."""

from wavequake.kernels.devices import Device
from wavequake.kernels.sequence import Moving, Rays, Sequence, TracedRays, check_sequence
from wavequake.kernels.sequential_numpy import trace_sequence_numpy


def trace_sequence(
    sequence: Sequence, rays: Rays, moving: Moving, device: Device, ignore_apertures: bool = False
) -> TracedRays:
    """Trace N rays at T instants through L elements, and to the reference sphere if there is one.

    Parameters
    ----------
    sequence : Sequence
        What does not move.
    rays : Rays
        Where the rays start, the same at all instants.
    moving : Moving
        Poses, deformations and reference spheres of every instant.
    device : Device
        Where to run (see `wavequake.kernels.devices`).
    ignore_apertures : bool
        Whether rays pass outside the openings too, as a virtual chief ray does.

    Returns
    -------
    TracedRays
        Path length, place and direction of every ray and instant, shape (T, N), in the frame of the last
        element; a lost ray is NaN, and its status and surface say why and where.

    Raises
    ------
    UserError
        If a surface has coefficients that are not finite.
    ValueError
        If shapes do not fit together.
    """
    check_sequence(sequence, rays, moving)
    return trace_sequence_numpy(sequence, rays, moving, ignore_apertures)
