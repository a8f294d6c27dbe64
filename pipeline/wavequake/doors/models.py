"""Finite-element models in one call each: load, shake, and as a plant for control software."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from pydantic import TypeAdapter, ValidationError

from wavequake.errors import UserError

if TYPE_CHECKING:
    import xarray as xr

    from wavequake.campaign.schema import Study
    from wavequake.mechanics.model import FiniteElementModel, Model
    from wavequake.mechanics.vibration.state_space import StateSpace

# A model of more coordinates is told how long all its modes take; times their third power, s.
_LONG, _FOR_ALL_S = 1500, 1.3e-9


def load_model(file: str | Path, **keywords: Any) -> "FiniteElementModel":
    """Return a finite-element model: a built-in mirror by name, or matrices and mesh from files.

    Parameters
    ----------
    file : str or Path
        "circular", "annular" or "hexagonal", or a file of CalculiX (.sti), Abaqus (.mtx), Nastran (.pch,
        .op4), Ansys (.full), Matrix Market, NumPy (.npz) or HDF5 (.h5).
    **keywords
        Of a built-in mirror those of `CircularMirror`, `AnnularMirror`, `HexagonalSegment`; of a file those
        of `wavequake.mechanics.importers.model.import_model`: ``units``, ``interfaces``, ``surface``...

    Raises
    ------
    UserError
        For a keyword that there is not, and for what is missing, damaged or contradictory in files.

    Examples
    --------
    >>> load_model("circular", core=2, rings=2).order
    855
    >>> load_model("plate.sti", units="mm,t,s,N", interfaces="MOUNTS", surface="FRONT")  # doctest: +SKIP
    """
    from wavequake.mechanics.importers.model import import_model
    from wavequake.mechanics.mirrors import models

    kinds: dict[str, tuple[Any, Any]] = {
        "circular": (models.circular_mirror, models.CircularMirror),
        "annular": (models.annular_mirror, models.AnnularMirror),
        "hexagonal": (models.hexagonal_segment, models.HexagonalSegment),
    }
    try:
        if str(file) in kinds:
            make, mirror = kinds[str(file)]
            model: FiniteElementModel = make(mirror(**keywords))
            return model
        needed = {"units": None, "interfaces": (), "surface": ()}
        return import_model(file, **(needed | keywords)).model
    except TypeError as error:
        if "keyword argument" not in str(error):
            raise
        raise UserError(f"The model {file}: {str(error).partition(') ')[2] or error}.") from None


def respond(
    model: "Model", excitation: Mapping[str, Any], *, duration: float = 0.05, step: float = 2.5e-4
) -> "xr.Dataset":
    """Return how the optical surface of a model moves from rest.

    Parameters
    ----------
    model : FiniteElementModel or ReducedModel
        Of at most 3000 coordinates; `wavequake.reduce` makes smaller ones.
    excitation : mapping
        What an ``[[excitation]]`` of a study says: ``{"kind": "sinusoid", "frequency_hz": 300.0, ...}``.
    duration, step : float
        s.

    Returns
    -------
    xarray.Dataset
        ``displacement`` (time, node, direction) in m, and the coordinates of the nodes.

    Raises
    ------
    UserError
        If the excitation is none, does not fit the model, or is too fast for the step.

    Examples
    --------
    >>> mirror = load_model("circular", core=2, rings=2)
    >>> shaken = respond(mirror, {"kind": "sinusoid", "name": "shaker", "frequency_hz": 300.0})
    >>> dict(shaken.sizes)["time"]
    201
    """
    import xarray as xr

    from wavequake.mechanics.model import rotations
    from wavequake.mechanics.vibration.excitations import AnyExcitation, drive_of
    from wavequake.mechanics.vibration.modal import LARGEST, modal_model
    from wavequake.mechanics.vibration.response import displacements
    from wavequake.mechanics.vibration.response import respond as response_of

    try:
        wanted = TypeAdapter(AnyExcitation).validate_python({"name": "excitation", **excitation})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"][1:])) or "kind"
        raise UserError(f"The excitation: {where}: {first['msg']}.") from None
    if not (0.0 < step < duration < np.inf):
        raise UserError(f"{duration} s in steps of {step} s are no instants; the step must be the shorter.")
    time = np.arange(round(duration / step) + 1, dtype=np.float64) * step
    drive = drive_of(wanted, len(model.interfaces), time, turns=rotations(model))
    if _LONG < (order := model.mass.shape[0]) <= LARGEST:
        words = f"all {order} modes of {model.name} are computed, some {_FOR_ALL_S * order**3:.0f} s"
        print(f"Wavequake responds: {words}; wavequake.reduce makes smaller models.", file=sys.stderr)
    found = response_of(modal_model(model, drive.prescribed), [drive], time)
    moved = displacements(found, model.surface)[0].reshape(len(time), -1, 3)
    nodes = model.nodes[model.surface_nodes]
    return xr.Dataset(
        {"displacement": (("time", "node", "direction"), moved, {"units": "m"})},
        {
            "time": ("time", time, {"units": "s"}),
            "direction": ["x", "y", "z"],
            **{f"node_{axis}": ("node", nodes[:, k], {"units": "m"}) for k, axis in enumerate("xyz")},
        },
        {"model": model.name},
    )


@overload
def plant(model: "Model", outputs: Any = None) -> "StateSpace": ...
@overload
def plant(model: "str | Path | Study") -> Any: ...
def plant(model: "Model | str | Path | Study", outputs: Any = None) -> Any:
    """Return a model as a state space from forces at its interfaces, or the plant of a study with loops.

    Parameters
    ----------
    model : FiniteElementModel, ReducedModel, or a study
        A model of at most 3000 coordinates. A study by name or file, or `load_study` of it: its first loop's
        plant, as `loop` gives it.
    outputs : ndarray or sparse array, shape (m, n), optional
        Rows that make the outputs of the model's coordinates, such as ``model.surface``; by default the
        displacements of the interfaces.

    Returns
    -------
    StateSpace
        ``(a, b, c, d)``, which `scipy.signal.StateSpace` and `control.ss` unpack; of a study a
        ``control.StateSpace``.

    Raises
    ------
    UserError
        If the model is too large, the rows do not fit it, or the study has no loops.

    Examples
    --------
    >>> plant(load_model("circular", core=2, rings=2)).b.shape[1]
    9
    """
    from wavequake.campaign.schema import Study
    from wavequake.mechanics.vibration.modal import modal_model
    from wavequake.mechanics.vibration.state_space import state_space

    if isinstance(model, str | Path | Study):
        return loop(model)[0]
    return state_space(modal_model(model), model.inputs.T if outputs is None else outputs)


def loop(study: "str | Path | Study", name: str | None = None) -> tuple[Any, Any]:
    """Return plant and controller of a loop of a study, for python-control.

    The loop is u = -H y: ``plant * controller`` is its loop gain, ``control.feedback(plant, controller)`` has
    its poles.

    Parameters
    ----------
    study : str, Path or Study
        Of a workflow with loops, by name or file, or `load_study` of it.
    name : str, optional
        As `wavequake margins` prints it; by default the first one.

    Returns
    -------
    plant, controller : control.StateSpace
        Continuous with forces in N and readings in m (``controller-mor``), or by frames in mas, where the
        plant is the delay (``tip-tilt-vibration``).

    Raises
    ------
    UserError
        If the study has no loops, or none of this name, or python-control is not installed.

    Examples
    --------
    >>> plant, controller = loop("tip-tilt-vibration", "lqg, 500 Hz")
    >>> plant.dt
    0.002
    """
    from wavequake.campaign.schema import Study
    from wavequake.control.python_control import to_control
    from wavequake.workflows.loops.loop_margins import loop_named
    from wavequake.workflows.study import load_study

    found = loop_named(study if isinstance(study, Study) else load_study(study), name)
    return to_control(found.plant), to_control(found.controller)
