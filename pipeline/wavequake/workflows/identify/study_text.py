"""A study file whose sources do what was measured, with the rest of another study as it stands."""

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wavequake.errors import UserError
from wavequake.mechanics.telemetry.line import Line
from wavequake.user_files import read_text, read_toml
from wavequake.workflows.identify.identify import Identified, floor_patterns
from wavequake.workflows.study import bundled_studies, study_of

_HEADER = re.compile(r"^\s*\[\[?\s*(?P<name>[\w.\"'-]+(?:\s*\.\s*[\w\"'-]+)*)\s*\]\]?\s*(?:#.*)?$")
_INSTANTS = 64


def study_text(found: Identified, source: str, data: str, folder: Path) -> str:
    """Return the text of a study that `wavequake run` takes.

    Parameters
    ----------
    found : Identified
    source : str
        The study whose disturbances are replaced: a bundled name, or a path.
    data : str
        Name of the record's file, for comments.
    folder : Path
        Where the text will stand, from which the files that it names are looked for.

    Raises
    ------
    UserError
        If nothing was found, or the study's text cannot be taken over.
    """
    sources = list(_sources(found))
    if not sources:
        raise UserError("Neither lines nor a background were found that move anything: there is no source.")
    path = bundled_studies().get(source, Path(source))
    text = read_text(path)
    before = read_toml(text)
    name = str(before["study"]["name"])
    kept = _without_disturbances(text).replace(json.dumps(name), json.dumps(f"{name}-measured"), 1)
    duration = min(max(1.0, 20.0 / found.spectra.frequency[0]), 0.5 * found.record.duration)
    head = (
        f"# What was measured in {data}, as sources of the study {name}: written by `wavequake identify`.\n"
        f"# {len(found.record.values)} samples, {found.record.duration:.6g} s; 95 % intervals in brackets.\n"
    )
    names = [one for one, _ in sources]
    common = f"share = 0\nduration_s = {duration:.6g}\ninstants = {_INSTANTS}\n"
    parts = "\n".join(body.replace("@common@\n", common) for _, body in sources)
    if len(names) == 1:
        parts = parts.replace("share = 0\n", "")
        together = ""
    else:
        together = (
            '\n# All of it at once: the cases of this study.\n[[disturbance]]\nname = "measured"\n'
            f'model = "combine"\nof = {json.dumps(names)}\nduration_s = {duration:.6g}\n'
            f"instants = {_INSTANTS}\n"
        )
    made = f"{head}{kept.rstrip()}\n\n{_modes(found)}{parts}{together}"
    after = read_toml(made)
    for record in (before, after):
        record.pop("disturbance", None)
        record.get("structure", {}).pop("mode", None)
    others = {*before, *after} - {"study", "structure"}
    unlike = [key for key in others if before.get(key) != after.get(key)]
    unlike += ["structure"] if before.get("structure", {}) != after.get("structure", {}) else []
    if unlike or after["study"] != before["study"] | {"name": f"{name}-measured"}:
        raise UserError(
            f"The text of {path} cannot be taken over; write its disturbances under lines of their own, "
            "[[disturbance]], behind all other keys."
        )
    try:
        study_of(read_toml(made), f"the study from {data}", folder, ())
    except UserError as error:
        raise UserError(
            f"{error} (Disturbances of {path.name} were replaced; files that it names are looked for beside "
            "the new file.)"
        ) from None
    return made


def _modes(found: Identified) -> str:
    """Return the modes of the structure that were measured."""
    text = ""
    for one in found.modes:
        frequency, damping, covariance = one.updated()
        errors = np.sqrt(np.diag(covariance))
        text += (
            f"# Mode {one.number}: {one.model_hz:.5g} Hz and {100.0 * one.model_damping:.3g} % in the model. "
            f"The errors' correlation is {covariance[0, 1] / errors.prod():.2g}.\n"
            f"[[structure.mode]]\nnumber = {one.number}\nfrequency_hz = {frequency:.8g}\n"
            f"damping_ratio = {damping:.5g}\nfrequency_error = {errors[0]:.3g}\n"
            f"damping_error = {errors[1]:.3g}\n\n"
        )
    return text


def _without_disturbances(text: str) -> str:
    """Return a study's text without its disturbances, and the comments right above them."""
    kept: list[str] = []
    inside = False
    for line in text.splitlines():
        if header := _HEADER.match(line):
            name = re.sub(r"[\s\"']", "", header["name"])
            inside = name.split(".")[0] == "disturbance" or name == "structure.mode"
            while inside and kept and kept[-1].lstrip().startswith("#"):
                kept.pop()
        if not inside:
            kept.append(line)
        elif line.lstrip().startswith("#"):
            kept.append(line)  # perhaps about what follows; taken back if that is a disturbance
    return "\n".join(kept) + "\n"


def _sources(found: Identified) -> Iterator[tuple[str, str]]:
    """Yield name and text of each source."""
    for number, line in enumerate(found.lines):
        pattern = found.pattern(number)
        if pattern:
            name = f"line-{number + 1}"
            yield name, _block(name, pattern, _of_line(line), _said(line, found, number))
    bands = found.floor.edges_hz
    for number, (pattern, density, share) in enumerate(floor_patterns(found)):
        name = f"rest-{number + 1}"
        rms = float(np.sqrt(np.sum(density * np.diff(bands))))
        size = rms * float(np.sqrt(np.sum(np.square(list(pattern.values())))))
        places = [bands[0], *found.floor.middles_hz, bands[-1]]
        rows = zip(places, np.pad(density, 1, mode="edge") / rms**2, strict=True)
        table = "frequency_hz,psd\n" + "".join(f"{f:.6g},{value:.4e}\n" for f, value in rows)
        words = [f"# What is left beside the lines, part {number + 1}: {size:.4g} rms"]
        if share < 0.99:
            words.append(f"# (motions explain {share:.0%} of its mean square; the rest is left out).")
        scaled = {key: value * rms for key, value in pattern.items()}
        spectrum = f'[disturbance.spectrum]\nrms = 1.0\nfile_csv = """\n{table}"""\n'
        yield name, _block(name, scaled, spectrum, words)


def _of_line(line: Line) -> str:
    width = f", fwhm_hz = {line.fwhm_hz:.6g}" if line.resolved else ""
    return f"lines = [{{ frequency_hz = {line.frequency_hz:.9g}{width}, rms = 1.0 }}]\n"


def _block(name: str, pattern: Mapping[str, float], what: str, said: list[str]) -> str:
    values = ", ".join(f"{json.dumps(key)} = {float(f'{value:.6g}')!r}" for key, value in pattern.items())
    return (
        "\n".join(said) + f'\n[[disturbance]]\nname = {json.dumps(name)}\nmodel = "pattern-vibration"\n'
        f"@common@\npattern = {{ {values} }}\n{what}"
    )


def _said(line: Line, found: Identified, number: int) -> list[str]:
    (low, high), damped, *ends = line.interval
    words = [f"# {line.frequency_hz:.6g} Hz [{low:.6g}, {high:.6g}],"]
    if line.resolved:
        low, high = 100.0 * damped
        words[0] += f" damping {100.0 * line.damping:.3g} % [{low:.3g}, {high:.3g}]"
    else:
        words[0] += f" a sinusoid: damping below {100.0 * line.damping:.2g} %"
    for one, value, (low, high) in zip(found.record.channels, line.rms, ends, strict=True):
        words.append(f"#   {one.name}: {value:.4g} rms [{low:.4g}, {high:.4g}]")
    explanation: Any = found.explanations[number]
    if explanation is not None:
        words.append(f"# {explanation_words(found, number)}")
    return words


def explanation_words(found: Identified, number: int) -> str:
    """Say what moves at a line."""
    explanation = found.explanations[number]
    if explanation is None:
        return "any motion that turns the line of sight"
    sets = [" with ".join(one) for one in explanation.alone]
    if not sets:
        moving = list(dict.fromkeys(element for element, _ in explanation.motion))
        return (
            f"no two elements alone: {', '.join(moving) or 'nothing'} together explain "
            f"{explanation.share:.0%}"
        )
    shown = sets[:6] + (["..."] if len(sets) > 6 else [])
    return shown[0] if len(sets) == 1 else f"one of {', '.join(shown)} (these cannot be told apart)"
