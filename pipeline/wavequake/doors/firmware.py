"""Boards of the lens experiment: build, try and flash them; `wavequake firmware` prints what these return."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavequake.campaign.schema import Study
from wavequake.workflows.study import chosen_study

if TYPE_CHECKING:
    import pandas as pd

    from wavequake.workflows.lens.boards import Designed


def build_firmware(
    study: str | Path | Study = "lens-experiment",
    to: str | Path = "firmware-build",
    *,
    boards: str | Iterable[str] = ("due",),
    arithmetic: str = "q31",
    controller: str | Path = "nominal",
    plant: int = 0,
    record: str | Path | None = None,
    **overrides: Any,
) -> list[Path]:
    """Design the regulator of a study, write its gains as a C header, and build images of boards.

    Parameters
    ----------
    study : str, Path or Study
        Of the workflow lens-experiment.
    to : str or Path
        Folder of headers and images.
    boards : iterable of {"due", "uno", "qemu", "simavr", "host"}, or one of them
        None of them: the header alone.
    arithmetic : {"float", "q31", "q16"}
    controller : str or Path
        ``"nominal"``; ``"identified"``, of a drawn plant; or an .npz file of a sampled linear controller.
    plant : int
        Which plant is identified.
    record : str or Path, optional
        CSV of an uncontrolled run, from which the bench is identified instead.
    **overrides
        Further keys with double underscores for dots, e.g. ``controller__modal_step_ms=4``.

    Returns
    -------
    list of Path
        The images, or the header.

    Raises
    ------
    UserError
        If the study is of another kind, there is no such board, arithmetic or controller, or no compiler.

    Examples
    --------
    >>> build_firmware(to="images", boards=["due", "uno"])  # doctest: +SKIP
    """
    from wavequake.firmware.build import build, write_header
    from wavequake.firmware.gains import gains_of

    made, folder = _designed(study, overrides, controller, plant, record), Path(to)
    gains = gains_of(made.regulator, made.chain, arithmetic)
    names = [boards] if isinstance(boards, str) else list(boards)
    if not names:
        return [write_header(gains, folder) / "wq_gains.h"]
    return [build(board, gains, folder).path for board in names]


def try_firmware(
    study: str | Path | Study = "lens-experiment",
    to: str | Path = "firmware-build",
    *,
    controller: str | Path = "nominal",
    plant: int = 0,
    **overrides: Any,
) -> "pd.DataFrame":
    """Run the images in emulators on a simulated blow, and compare their commands with the host's.

    Parameters
    ----------
    study, to, controller, plant, **overrides
        As of `build_firmware`.

    Returns
    -------
    pandas.DataFrame
        A row per image: ``flash`` in bytes, ``instructions`` and ``seconds`` of the longest step, whether its
        commands are the ``same`` bit by bit, or why it was ``skipped``.

    Raises
    ------
    UserError
        As `build_firmware`.

    Examples
    --------
    >>> try_firmware()["same"].isin([True, None]).all()  # doctest: +SKIP
    True
    """
    import pandas as pd

    from wavequake.workflows.lens.boards import blow_of, tried

    made = _designed(study, overrides, controller, plant, None)
    return pd.DataFrame([vars(one) for one in tried(made, blow_of(made), Path(to))])


def flash_firmware(
    board: str,
    study: str | Path | Study = "lens-experiment",
    to: str | Path = "firmware-build",
    *,
    arithmetic: str = "q31",
    controller: str | Path = "nominal",
    plant: int = 0,
    record: str | Path | None = None,
    **overrides: Any,
) -> str:
    """Check that an image was built from the study's design, and return the lines that flash it.

    Nothing is flashed.

    Parameters
    ----------
    board : {"due", "uno"}
    study, to, arithmetic, controller, plant, record, **overrides
        As of `build_firmware`.

    Raises
    ------
    UserError
        If the board is no hardware, or the image is missing or of another design.

    Examples
    --------
    >>> print(flash_firmware("due"))  # doctest: +SKIP
    """
    from wavequake.workflows.lens.boards import flashing

    made = _designed(study, overrides, controller, plant, record)
    return flashing(made, board, arithmetic, Path(to))[2]


def _designed(
    study: str | Path | Study,
    overrides: dict[str, Any],
    controller: str | Path,
    plant: int,
    record: str | Path | None,
) -> "Designed":
    from wavequake.workflows.lens.boards import designed

    file = None if record is None else Path(record)
    return designed(chosen_study(study, overrides), str(controller), plant, file)
